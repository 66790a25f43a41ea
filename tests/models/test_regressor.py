"""The network: its initial predictions, gradients and precision."""

from functools import partial

import pytest
import torch
from torch import nn
from torch.nn.functional import layer_norm
from torchvision.models.resnet import BasicBlock, Bottleneck
from torchvision.models.resnet import ResNet as TorchvisionResNet

from phd_exp.geometry import Camera, Cartesian, DepthScale, LogDepth, Projected
from phd_exp.losses import MeanAbsoluteError, NegativeLogLikelihood
from phd_exp.models.backbones import BackboneOutput, PooledFeatures, resnet
from phd_exp.models.heads import ChartHead, DistributionHead, Head, SurrogateHead
from phd_exp.models.regressor import Regressor
from phd_exp.models.residual import Depth
from tests.support.heads import SHAPED

DEPTH = DepthScale.from_ranges(f_range=(1200.0, 2000.0), z_range=(3.0, 5.0))
HEADS: dict[str, Head] = {
    "probabilistic": DistributionHead(DEPTH),
    "free_axis": DistributionHead(DEPTH, free_axis=True),
    "rounded_t": SurrogateHead(DEPTH, is_rounded=True),
    "mae_vz": ChartHead(DEPTH, Projected),
    "mae_logz": ChartHead(DEPTH, LogDepth),
    "mae_xyz": ChartHead(DEPTH, Cartesian),
    **SHAPED,
}
LOSSES = {name: NegativeLogLikelihood() for name in ("probabilistic", "free_axis", "rounded_t", *SHAPED)}


@pytest.fixture
def camera() -> Camera:
    return Camera(torch.tensor([1200.0, 1500.0, 1800.0, 2000.0]), 224.0)


@pytest.fixture
def image() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (4, 64, 64, 3), generator=generator, dtype=torch.uint8)


@pytest.fixture
def xyz() -> torch.Tensor:
    return torch.tensor([[0.1, -0.2, 3.1], [-0.2, 0.1, 4.9], [0.05, 0.2, 3.7], [-0.1, -0.1, 4.2]])


def regressor(head: Head) -> Regressor:
    torch.manual_seed(0)
    return Regressor(resnet(18), head)


@pytest.mark.parametrize("name", HEADS)
def test_every_output_learns_from_the_first_step(
    name: str, image: torch.Tensor, camera: Camera, xyz: torch.Tensor
) -> None:
    network = regressor(HEADS[name])
    loss = LOSSES.get(name, MeanAbsoluteError())(network(image, camera), xyz)
    loss.mean().backward()
    assert loss.isfinite().all()
    gradient = network.last.weight.grad
    assert gradient.isfinite().all()
    assert (gradient.abs().amax(dim=1) > 1e-4).all(), gradient.abs().amax(dim=1)


def test_hidden_layers_predict_what_no_linear_layer_can() -> None:
    """The product of two features."""
    features = layer_norm(torch.randn(256, 4, generator=torch.Generator().manual_seed(0)), (4,))
    product = features[:, :1] * features[:, 1:2]

    def error(hidden: int) -> float:
        torch.manual_seed(0)
        network = Regressor(PooledFeatures(nn.Identity(), 4), HEADS["mae_vz"], hidden=hidden)
        assert (network.numbers(BackboneOutput(features), None) == 0).all()
        optimizer = torch.optim.Adam([*network.parameters()], lr=0.01)
        for _ in range(150):
            loss = (network.numbers(BackboneOutput(features), None) - product).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        return loss.item()

    assert error(hidden=32) < 0.02 < 0.5 < error(hidden=0)


def test_channels_last_changes_no_number(image: torch.Tensor, camera: Camera) -> None:
    network = regressor(HEADS["mae_vz"])
    torch.nn.init.normal_(network.last.weight)
    raw = network.raw(image)
    network.backbone.to(memory_format=torch.contiguous_format)
    torch.testing.assert_close(network.raw(image.contiguous()), raw, rtol=1e-4, atol=1e-4)


def test_the_input_images_do_not_change(image: torch.Tensor) -> None:
    before = image.clone()
    regressor(HEADS["mae_vz"]).raw(image)
    assert torch.equal(image, before)


@pytest.mark.parametrize(
    ("depth", "block", "counts"), [(34, BasicBlock, (3, 4, 6, 3)), (50, Bottleneck, (3, 4, 6, 3))]
)
def test_resnets_are_torchvisions_with_group_norm(depth: Depth, block: type, counts: tuple[int, ...]) -> None:
    """The same weights from the same seed, under the same names, and the same features to the bit."""
    torch.manual_seed(0)
    theirs = TorchvisionResNet(block, [3, 4, 6, 3], norm_layer=partial(torch.nn.GroupNorm, 1))
    theirs.fc = torch.nn.Identity()
    torch.manual_seed(0)
    ours = resnet(depth).network
    weights = ours.state_dict()
    assert weights.keys() == theirs.state_dict().keys()
    assert all(torch.equal(weights[name], value) for name, value in theirs.state_dict().items())
    pixels = torch.rand(2, 3, 64, 64)
    assert torch.equal(ours(pixels), theirs(pixels))


def test_under_autocast_the_last_layer_stays_in_float32(image: torch.Tensor, camera: Camera) -> None:
    network = regressor(HEADS["probabilistic"])
    with torch.autocast("cpu", torch.bfloat16):
        assert network.backbone(torch.rand(1, 3, 64, 64)).features.dtype == torch.bfloat16
        assert network.raw(image).dtype == torch.float32


def test_normalises_as_torchvision_does(image: torch.Tensor) -> None:
    from torchvision.transforms.v2.functional import normalize

    network = regressor(HEADS["mae_vz"])
    seen = []
    network.backbone.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    network.raw(image)
    expected = normalize(image.permute(0, 3, 1, 2) / 255, mean=[0.485, 0.456, 0.406], std=[0.229, 0.224, 0.225])
    torch.testing.assert_close(seen[0], expected)


def test_images_and_cameras_may_shrink_together(camera: Camera, xyz: torch.Tensor) -> None:
    """The full density does not change when an image, f, S and mu_z0 are resized together."""
    raw = torch.linspace(-1, 1, 28).view(4, 7)
    whole = DistributionHead(DEPTH)(raw, camera).log_prob(xyz)
    half = DistributionHead(DEPTH.scaled(0.5))(raw, Camera(camera.f / 2, camera.S / 2)).log_prob(xyz)
    torch.testing.assert_close(half, whole)


@pytest.mark.parametrize("gain", [(0.5, 0.5, 0.5), (1.5, 1.5, 1.5), (0.5, 1.0, 1.5)])
def test_corrected_images_do_not_depend_on_brightness_and_white_balance(
    image: torch.Tensor, gain: tuple[float, float, float]
) -> None:
    before = image // 4 * 2  # no value is rounded or clipped below
    after = (before.double() * torch.tensor(gain)).to(torch.uint8)
    torch.manual_seed(0)
    network = Regressor(resnet(18), HEADS["probabilistic"], exposure=True).requires_grad_(False).eval()
    features = [network.see(pictures).features for pictures in (before, after)]
    assert torch.allclose(*features, atol=1e-4 * float(features[0].abs().max()), rtol=0)
    plain = Regressor(network.backbone, HEADS["probabilistic"]).eval()
    assert not torch.allclose(plain.see(before).features, plain.see(after).features, atol=0.01, rtol=0)


def test_a_black_image_is_no_division_by_zero() -> None:
    network = Regressor(resnet(18), HEADS["probabilistic"], exposure=True)
    assert network.see(torch.zeros(1, 64, 64, 3, dtype=torch.uint8)).features.isfinite().all()


def test_training_fits_the_surrogate_of_a_head_that_has_one(
    image: torch.Tensor, camera: Camera, xyz: torch.Tensor
) -> None:
    """So that its gradients are those of the Student's t."""
    gradients = []
    for name in ("rounded_t", "student_t"):
        network = regressor(HEADS[name]).train()
        prediction, trained = network.trained(network.see(image), camera)
        NegativeLogLikelihood()(trained, xyz).mean().backward()
        gradients.append(network.last.weight.grad)
        assert (prediction is trained) == (name == "student_t")
    assert all(torch.equal(gradient, gradients[-1]) for gradient in gradients)
