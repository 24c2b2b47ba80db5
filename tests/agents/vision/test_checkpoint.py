"""Files of the ego with a camera."""

from pathlib import Path

import pytest
import torch

import agents
from agents import Provenance, load_ego
from agents.learned.checkpoints import write_file
from agents.vision.checkpoint import holds_vision, load_vision, read_vision_provenance, save_vision
from agents.vision.ego import VisionEgo
from agents.vision.pilotnet import PilotNet, luma


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
    assert read_vision_provenance(path) == provenance


def test_files_of_another_kind_are_refused() -> None:
    with pytest.raises(ValueError, match="no vision"):
        load_vision(Path("agents/data/gail.safetensors"))
    with pytest.raises(FileNotFoundError, match="No vision at"):
        load_vision("nowhere.safetensors")


def test_a_damaged_or_foreign_network_is_refused(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = PilotNet()
    provenance = Provenance(kind="-", command="-", data="-", data_licence="-")
    with torch.no_grad():
        network.head.bias[0] = torch.nan
    with pytest.raises(ValueError, match=r"inf or NaN in head\.bias"):
        save_vision(network, provenance, tmp_path / "nan.safetensors")
    assert list(tmp_path.iterdir()) == []
    tensors = {name: value.contiguous() for name, value in PilotNet().state_dict().items()}
    form = {"format": 1, "observation": "camera+speed", "picture": [66, 200], "lag": 5}
    for change, reason in (({"lag": 3}, "has lag 3; this version reads 5"), ({"format": 2}, "has format 2")):
        path = write_file(tmp_path / "other.safetensors", tensors, "vision", {**form, **change})
        with pytest.raises(ValueError, match=reason):
            load_vision(path)
    tensors["head.bias"] = torch.zeros(3)
    path = write_file(tmp_path / "shape.safetensors", tensors, "vision", form)
    with pytest.raises(ValueError, match=r"head\.bias of shape \(2,\)"):
        load_vision(path)


def test_a_file_tells_whether_it_holds_a_network_with_a_camera(tmp_path: Path) -> None:
    data = Path(agents.__file__).parent / "data"
    assert holds_vision(data / "vision.safetensors")
    assert not holds_vision(data / "mgail.safetensors")
    (tmp_path / "text.safetensors").write_text("no tensors")
    assert not holds_vision(tmp_path / "text.safetensors")
    assert not holds_vision(tmp_path / "missing.safetensors")
