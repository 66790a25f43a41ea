"""Networks of timm: their weights, images normalised for them, and what training leaves as it is."""

from pathlib import Path
from typing import Any
from urllib.error import URLError

import pytest
import timm
import torch
from torch.testing import assert_close

from phd_exp.models.locating import LocatingNetwork
from phd_exp.models.regressor import IMAGENET_MEAN, IMAGENET_STD
from phd_exp.models.timm_maps import TimmMaps

TINY = "test_resnet"
FROZEN = ("conv1", "layer1", "*.conv2")


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Of the complete network, with means and variances of BatchNorm that are not 0 and 1."""
    torch.manual_seed(0)
    complete = timm.create_model(TINY)
    complete(torch.randn(4, 3, 64, 64))
    torch.save(complete.state_dict(), tmp_path / "tiny.pth")
    return tmp_path / "tiny.pth"


def test_the_maps_are_those_of_timm_for_images_as_timm_normalises_them(weights: Path) -> None:
    maps = TimmMaps(TINY, str(weights)).eval()
    theirs = timm.create_model(
        TINY, features_only=True, out_indices=(1, 2, 3, 4), pretrained=True, pretrained_cfg_overlay={"file": weights}
    ).eval()
    config = timm.get_pretrained_cfg(TINY)
    assert config.mean != IMAGENET_MEAN  # otherwise nothing would be tested
    images = torch.rand(2, 3, 64, 64)
    ours, expected = (
        network((images - torch.tensor(mean)[:, None, None]) / torch.tensor(std)[:, None, None])
        for network, mean, std in ((maps, IMAGENET_MEAN, IMAGENET_STD), (theirs, config.mean, config.std))
    )
    assert_close(ours, expected)


def test_training_leaves_frozen_modules_and_the_statistics_of_all_layers(weights: Path) -> None:
    network = LocatingNetwork(TimmMaps(TINY, str(weights), FROZEN), channels=6, side=64).train()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    output = network(torch.randn(4, 3, 64, 64))
    (output.features.square().mean() + output.log_heat.square().mean()).backward()
    torch.optim.SGD(network.parameters(), lr=0.1).step()
    changed = {
        name.removeprefix("network.network.")
        for name, value in network.state_dict().items()
        if not torch.equal(value, before[name])
    }
    assert {"map.weight", "bn1.weight", "layer2.0.bn2.weight", "layer2.0.downsample.1.weight"} <= changed
    assert not [name for name in changed if name.startswith(("conv1.", "layer1.")) or "conv2." in name]
    assert not [name for name in changed if "running" in name]


def test_without_internet_a_file_is_asked_for_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def offline(*_: Any, **__: Any) -> None:
        raise URLError(OSError(-2, "Name or service not known"))

    monkeypatch.setattr("phd_exp.models.timm_maps.urlopen", offline)
    monkeypatch.setattr("huggingface_hub.try_to_load_from_cache", lambda *_: None)
    with pytest.raises(ValueError, match=r"backbone\.network\.pretrained=FILE, .* \(Name or service not known\)"):
        TimmMaps(TINY, True)


def test_without_frozen_modules_all_is_trained(weights: Path) -> None:
    maps = TimmMaps(TINY, str(weights)).train()
    before = maps.network.bn1.running_mean.clone()
    maps(torch.randn(4, 3, 64, 64))
    assert all(weight.requires_grad for weight in maps.parameters())
    assert not torch.equal(maps.network.bn1.running_mean, before)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "test_resnt"}, "test_resnt: unknown network, did you mean 'test_resnet'"),
        ({"name": "hf-hub:timm/test_resnet"}, r"expected one of timm\.list_models"),
        ({"frozen": ["layer5"]}, "layer5: unknown module, did you mean 'layer.'.?; expected modules of the network"),
        ({"pretrained": "no.pth"}, r"pretrained: got 'no\.pth'; expected a file with .* \(FileNotFoundError\)"),
        ({"name": "test_efficientnet", "pretrained": "tiny.pth"}, r"expected a file with this .* \(.*bn1\."),
        ({"name": "test_vit", "pretrained": "tiny.pth"}, r"expected a file with this .* \(no .*\)"),
    ],
    ids=str,
)
def test_what_is_not_there_is_named(
    arguments: dict, message: str, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(weights.parent)
    with pytest.raises(ValueError, match=message):
        TimmMaps(**{"name": TINY} | arguments)
