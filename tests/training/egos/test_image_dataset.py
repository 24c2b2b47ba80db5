"""Pictures carry the outputs of the expert, mirrored with the picture."""

import numpy as np
import torch

from agents.vision import PilotNet
from training.egos.curriculum import make_situations, start_situation
from training.egos.image_dataset import collect, concatenate, drive_and_label, mirror


def test_pictures_are_noted_with_what_the_expert_would_do() -> None:
    rng = np.random.default_rng(2)
    parts = list(collect(None, 0.0, drives=2, rows=3, ticks=3, recorded_share=1.0, noise=1.0, rng=rng))
    noted = concatenate(parts)
    assert noted.picture.shape == (18, 66, 200, 3)
    assert torch.equal(noted.earlier[:3], _luma(noted.picture[:3]))  # at time 0 there is no earlier one
    assert noted.expert.shape == (18, 2) and noted.truth.shape == (18, 5)


def test_pictures_for_the_expert_and_for_a_network_are_the_same() -> None:
    """Where nobody trusts the network, the expert alone drives, by pictures that are all taken."""
    settings = {"drives": 1, "rows": 2, "ticks": 8, "recorded_share": 1.0, "noise": 0.0}
    torch.manual_seed(0)
    network = PilotNet().eval()
    alone = concatenate(list(collect(None, 0.0, rng=np.random.default_rng(3), **settings)))
    mixed = concatenate(list(collect(network, 0.0, rng=np.random.default_rng(3), **settings)))
    assert torch.equal(alone.picture[:4], mixed.picture[:4])
    assert torch.equal(alone.earlier, mixed.earlier)
    torch.testing.assert_close(alone.expert, mixed.expert)


def test_the_first_ticks_are_recorded_whatever_the_share() -> None:
    rng = np.random.default_rng(5)
    world, episode = start_situation(make_situations()[1], 2, 0.4, rng)
    parts = list(drive_and_label(world, episode, None, 0.0, 4, 0.0, 0.0, rng, first_ticks=3))
    assert [len(part.speed) for part in parts] == [2, 2, 2]
    assert torch.equal(parts[0].speed, episode.state.speed[:, 0])


def test_mirrored_pictures_ask_for_mirrored_turns() -> None:
    rng = np.random.default_rng(4)
    some = concatenate(list(collect(None, 0.0, drives=1, rows=4, ticks=1, recorded_share=1.0, noise=0.0, rng=rng)))
    turned = mirror(some, torch.tensor([True, False, True, False]))
    assert torch.equal(turned.picture[0], some.picture[0].flip(1)) and torch.equal(turned.picture[1], some.picture[1])
    assert torch.equal(turned.expert[0], some.expert[0] * torch.tensor([1.0, -1.0]))
    assert torch.equal(turned.truth[2], some.truth[2] * torch.tensor([-1.0, -1.0, -1.0, 1.0, 1.0]))
    assert all(torch.equal(a[1::2], b[1::2]) for a, b in zip(turned, some, strict=True))


def _luma(picture: torch.Tensor) -> torch.Tensor:
    return (picture.double() @ torch.tensor([77, 150, 29]).double() / 256 + 0.5).floor().to(torch.uint8)
