"""The ego that sees: its network, its memory, its file, and that it is shown what it needs wherever it is named."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import rare_envs
from agents import Provenance, load_ego, read_provenance
from agents.files import write_file
from agents.vision import (
    HEIGHT,
    LAG,
    WIDTH,
    PilotNet,
    VisionEgo,
    load_vision,
    luma,
    save_vision,
    to_actions,
    update_memory,
)

CUT_IN = "rare_envs/CutIn-v0"


@pytest.fixture(scope="module")
def ego() -> VisionEgo:
    return load_vision()


def pictures(n: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).integers(0, 256, (n, HEIGHT, WIDTH, 3), dtype=np.uint8))


def seen(n: int, seed: int = 0) -> dict[str, Any]:
    speed = np.random.default_rng(seed).uniform(0.0, 1.0, (n, 1)).astype(np.float32)
    return {"camera": pictures(n, seed).numpy(), "speed": speed}


def test_the_memory_is_of_the_last_pictures_row_by_row() -> None:
    shots = [pictures(2, seed) for seed in range(9)]
    state: Any = None
    for tick, shot in enumerate(shots):
        start = np.array([tick == 0, tick in (0, 4)])
        earlier, state = update_memory(shot, state, start)
        assert np.array_equal(earlier[0], luma(shots[max(tick - LAG, 0)])[0])
        assert np.array_equal(earlier[1], luma(shots[max(tick - LAG, 0 if tick < 4 else 4)])[1])
    assert state.shape == (2, LAG, HEIGHT, WIDTH)


def test_actions_have_the_units_of_the_environment() -> None:
    """An acceleration of 1 is 5 m/s^2; a steady turn on a circle of radius R steers by about length / R."""
    speed, radius = 20.0, 200.0
    turn = speed / radius  # rad/s
    action = to_actions(torch.tensor([[1.0, turn / 0.1]]), torch.tensor([speed]))[0]
    assert action[0] == pytest.approx(2.0 / 5.0)
    assert action[1] * 0.1 == pytest.approx(5.0 / radius, rel=1e-3)


def test_observations_of_another_form_are_refused(ego: VisionEgo) -> None:
    given: list[tuple[Any, str]] = [
        (np.zeros((2, 7), np.float32), 'observation="camera\\+speed"'),
        ({**seen(2), "camera": np.zeros((2, HEIGHT, WIDTH, 3), np.float32)}, "uint8"),
        ({**seen(2), "speed": np.zeros((3, 1), np.float32)}, "speed"),
    ]
    for observation, message in given:
        with pytest.raises(ValueError, match=message):
            ego.predict(observation)
    with pytest.raises(ValueError, match=r"Expected dt=0.1 s"):
        rare_envs.DrivingProblem(CUT_IN, ego=load_ego("vision"), dt=0.05)


def test_the_network_is_that_of_the_paper() -> None:
    """Bojarski et al., Fig. 4: sizes of the feature maps, and about 250,000 parameters."""
    network, maps = PilotNet(), []
    for convolution in network.convolutions:
        convolution.register_forward_hook(lambda _module, _given, out: maps.append(tuple(out.shape[1:])))
    with torch.no_grad():
        out = network(pictures(2), pictures(2)[..., 0], torch.tensor([3.0, 20.0]))
    assert out.shape == (2, 2)
    assert maps == [(24, 31, 98), (36, 14, 47), (48, 5, 22), (64, 3, 20), (64, 1, 18)]
    assert sum(weight.numel() for weight in network.parameters()) == 252_880


def test_channels_are_the_yuv_of_itu_bt_601() -> None:
    """U and V by their definitions as scaled differences of blue and red to the luma."""
    picture = pictures(1, 3)
    red, green, blue = (picture[..., k].double() for k in range(3))
    y = 0.299 * red + 0.587 * green + 0.114 * blue
    u, v = 0.436 * (blue - y) / (1 - 0.114), 0.615 * (red - y) / (1 - 0.299)
    earlier = pictures(1, 4)[..., 0]
    with torch.no_grad():
        channels = PilotNet().channels(picture, earlier).double()
    expected = torch.stack((y / 127.5 - 1, u / 127.5, v / 127.5, (y - earlier.double()) / 127.5), dim=1)
    assert channels.shape == (1, 4, HEIGHT, WIDTH)
    torch.testing.assert_close(channels, expected, atol=2e-5, rtol=0.0)
    assert float((luma(picture).double() - y).abs().max()) < 1.0


def test_a_network_of_ones_own_is_kept_in_a_file(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = PilotNet()
    provenance = Provenance(kind="dagger", command="train", data="none", data_licence="MIT", metrics={"kept": 1.0})
    path = save_vision(network, provenance, tmp_path / "mine.safetensors")
    loaded = load_ego(path)
    assert isinstance(loaded, VisionEgo)
    with torch.no_grad():
        picture = torch.randint(0, 256, (2, 66, 200, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
        arguments = picture, luma(picture), torch.tensor([3.0, 20.0])
        torch.testing.assert_close(loaded.network(*arguments), network(*arguments), atol=1e-5, rtol=0.0)
    assert read_provenance(path) == provenance


def test_a_damaged_or_foreign_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no vision"):
        load_vision(Path(__file__).parents[2] / "agents/data/gail.safetensors")
    tensors = PilotNet().state_dict()
    form = {"format": 1, "observation": "camera+speed", "picture": [66, 200], "lag": 5}
    for change, bias, reason in (
        ({"lag": 3}, 2, "has lag 3 where this version reads 5"),
        ({"format": 2}, 2, "has format 2"),
        ({"picture": [66, 100]}, 2, "has picture 100 where this version reads 200"),
        ({}, 3, r"head\.bias of shape \(2,\)"),
    ):
        given = {**tensors, "head.bias": torch.zeros(bias)}
        path = write_file(tmp_path / "other.safetensors", given, "vision", {**form, **change})
        with pytest.raises(ValueError, match=reason):
            load_vision(path)
