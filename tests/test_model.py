import numpy as np
import pytest

import shortfinal as sf

torch = pytest.importorskip("torch")

from shortfinal.train.model import MIN_SIGMA_PX, KeypointNet, soft_argmax  # noqa: E402

SMALL = "test_efficientnet"  # timm's own tiny ones
SIZE = 64


def net(seed=0, backbone=SMALL, **options):
    torch.manual_seed(seed)
    return KeypointNet(backbone, **{"width": 8} | options).eval()


def picture(count=2, size=SIZE):
    return torch.randn(count, 3, size, size, generator=torch.Generator().manual_seed(5))


def stirred(network, amount=0.03):
    """With weights that are not the first ones, so that no output is constant by initialisation."""
    with torch.no_grad():
        for part in network.parameters():
            part += amount * torch.randn(part.shape, generator=torch.Generator().manual_seed(part.numel()))
    return network


def test_soft_argmax_of_one_hot_attention_is_the_centre_of_the_cell():
    attention = torch.zeros(1, 1, 6 * 8)
    attention[0, 0, 2 * 8 + 5] = 1.0
    mean, spread = soft_argmax(attention, 6, 8)
    np.testing.assert_allclose(mean[0, 0], [5.5 / 8, 2.5 / 6])
    np.testing.assert_allclose(spread, 0, atol=1e-7)


def test_soft_argmax_moments_are_those_of_the_distribution():
    attention = torch.rand(2, 3, 20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    attention /= attention.sum(-1, keepdim=True)
    mean, spread = soft_argmax(attention, 4, 5)
    x = (np.arange(20) % 5 + 0.5) / 5
    p = attention[1, 2].numpy()
    assert float(mean[1, 2, 0]) == pytest.approx(p @ x)
    assert float(spread[1, 2, 0]) == pytest.approx(p @ (x - p @ x) ** 2)


def test_means_are_pixels_whose_first_has_its_centre_at_nought():
    # Attention alike everywhere: the middle of the picture, which 64 pixels have at 31.5.
    network = net()
    torch.nn.init.zeros_(network.score.weight)
    with torch.no_grad():
        prediction = network(picture())
    np.testing.assert_allclose(prediction.mean_px, 31.5, atol=1e-4)
    assert prediction.attention.shape == (2, 4, SIZE // 4, SIZE // 4)
    np.testing.assert_allclose(prediction.attention.exp().sum(dim=(2, 3)), 1, rtol=1e-5)
    # Attention in one cell of stride 4, the fifth across and third down: that cell's centre.
    where = torch.full((1, 4, 16 * 16), -100.0)
    where[..., 2 * 16 + 4] = 100.0
    network.score.register_forward_hook(lambda *_: where.unflatten(2, (16, 16)))
    with torch.no_grad():
        np.testing.assert_allclose(network(picture(1)).mean_px[0], [[4.5 * 4 - 0.5, 2.5 * 4 - 0.5]] * 4, atol=1e-4)


@pytest.mark.parametrize("covariance", ["diagonal", "keypoint", "full"])
@pytest.mark.parametrize("head", ["sam", "fc"])
def test_sigma_is_the_marginal_of_each_kind_of_covariance(head, covariance):
    with torch.no_grad():
        prediction = stirred(net(head=head, covariance=covariance, keypoints=8))(picture(3))
    assert prediction.mean_px.shape == prediction.sigma_px.shape == (3, 8, 2)
    assert prediction.visible.shape == (3, 8)
    assert prediction.present.shape == (3,)
    assert (prediction.attention is None) == (head == "fc")
    assert (prediction.sigma_px >= MIN_SIGMA_PX * (1 - 1e-6)).all()
    cov = prediction.cov_px.double()
    sigma = prediction.sigma_px.flatten(1).double()
    # Rows of length one to float32's rounding, and so the marginals.
    torch.testing.assert_close(cov.diagonal(dim1=1, dim2=2).sqrt(), sigma, rtol=1e-6, atol=0)
    assert (torch.linalg.eigvalsh(cov) > 0).all()
    # Which coordinates may be correlated, and that they are.
    keypoint = torch.arange(16) // 2
    linked = {
        "diagonal": torch.zeros(16, 16, dtype=torch.bool), "keypoint": keypoint[:, None] == keypoint,
        "full": torch.ones(16, 16, dtype=torch.bool),
    }[covariance].clone().fill_diagonal_(False)  # fmt: skip
    correlation = cov / (sigma[:, :, None] * sigma[:, None, :])
    off = ~torch.eye(16, dtype=torch.bool)
    assert (correlation[:, ~linked & off] == 0).all()
    assert (correlation[:, linked].abs() > 1e-5).all()


@pytest.mark.parametrize(
    ("backbone", "features", "size", "cells"),
    [(SMALL, (8, 32), 64, 8), ("test_resnet", (4, 8, 16, 32), 64, 16), ("test_convnext", (16,), 96, 6),
     ("test_vit", (16,), 64, 4), ("test_vit", (16,), 96, 6)],
)  # fmt: skip
def test_backbones_of_any_kind(backbone, features, size, cells):
    network = net(backbone=backbone, features=features)
    prediction = network(picture(2, size))
    assert prediction.attention.shape == (2, 4, cells, cells)
    assert ((prediction.mean_px > -0.5) & (prediction.mean_px < size - 0.5)).all()
    # Every part has a say: nothing is left without a gradient, which processes that share a batch would miss.
    sum(part.sum() for part in prediction[:2] + prediction[3:5]).backward()
    assert [name for name, weight in network.named_parameters() if weight.grad is None] == []


def test_as_published_there_is_one_convolution_behind_the_backbone():
    network = net(features=(32,))
    assert isinstance(network.neck, torch.nn.Identity)
    assert sum(weight.numel() for weight in network.score.parameters()) == 4 * (64 + 1)
    assert network(picture()).attention.shape == (2, 4, 2, 2)
    # The order and number of strides asked for is not the caller's business.
    assert net(features=(32, 8, 8)).backbone.feature_info.reduction() == [8, 32]


def test_the_parts_the_means_come_from_are_all_of_them():
    for head in ("sam", "fc"):
        network = net(head=head, covariance="full")
        before = network(picture())
        means = {weight for part in network.means for weight in part.parameters()}
        with torch.no_grad():
            for weight in network.parameters():
                if weight not in means:
                    weight += 1.0
        after = network(picture())
        assert torch.equal(before.mean_px, after.mean_px)
        assert (before.sigma_px != after.sigma_px).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"backbone": "nonsense"}, "backbone: 'nonsense': Unknown model"),
        ({"backbone": "test_vit"}, "features: 'test_vit' has the strides 16; 4, 8, 16, 32 wanted"),
        ({"backbone": SMALL, "features": (64,)}, f"features: '{SMALL}' has the strides 2, 4, 8, 16, 32; 64 wanted"),
        ({"backbone": SMALL, "features": ()}, f"features: '{SMALL}' has the strides .*; at least one wanted"),
        ({"head": "soft"}, "head: 'soft'; expected one of sam, fc"),
        ({"covariance": "none"}, "covariance: 'none'; expected one of diagonal, keypoint, full"),
    ],
)
def test_what_cannot_be_built_is_named_in_one_line(options, message):
    with pytest.raises(sf.InputError, match=f"^{message}"):
        KeypointNet(**options)


@pytest.mark.parametrize("head", ["sam", "fc"])
@pytest.mark.parametrize("covariance", ["diagonal", "keypoint", "full"])
def test_in_mixed_precision_places_keep_their_digits(head, covariance):
    """bfloat16 knows places of 64 to 128 px to half a pixel: what is told must lie between those steps too."""
    torch.manual_seed(0)
    net = KeypointNet("test_efficientnet", 4, head, covariance, width=8).eval()
    with torch.no_grad():
        for part in net.means[-1].parameters():
            part *= 30  # attention that looks somewhere
        image = torch.randn(8, 3, 160, 160, generator=torch.Generator().manual_seed(1))
        with torch.autocast("cpu", dtype=torch.bfloat16):
            said = net(image)
    assert all(part.dtype == torch.float32 for part in said if part is not None)
    steps = said.mean_px / 0.25
    assert ((steps - steps.round()).abs() > 0.02).float().mean() > 0.8
