from itertools import combinations

import numpy as np

from rare_envs.traffic.palette import CRASH_COLOUR, OTHER_COLOURS, ROLE_COLOURS, as_rgb, vehicle_colour


def test_no_two_vehicles_of_different_roles_look_alike() -> None:
    colours = [*ROLE_COLOURS.values(), *OTHER_COLOURS, CRASH_COLOUR]
    apart = [np.abs(np.subtract(as_rgb(a), as_rgb(b))).max() for a, b in combinations(colours, 2)]
    assert min(apart) >= 24  # of 255 in one channel at least


def test_names_decide_and_numbers_tell_others_apart() -> None:
    assert vehicle_colour("ego", 3) == ROLE_COLOURS["ego"]
    assert vehicle_colour("truck", 1) != vehicle_colour("truck", 2)
