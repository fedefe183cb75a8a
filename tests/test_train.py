import csv
import dataclasses

import numpy as np
import pytest

import shortfinal as sf
from shortfinal.data.dataset import write_dataset
from shortfinal.errors import JobError

torch = pytest.importorskip("torch")

from shortfinal.data.augment import random_warp  # noqa: E402
from shortfinal.train.export import compare, export, load_network  # noqa: E402
from shortfinal.train.fit import Recipe, train  # noqa: E402
from shortfinal.train.model import KeypointNet, gaussian_nll, soft_argmax, to_pixels, variance_px  # noqa: E402


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    folder = tmp_path_factory.mktemp("training")
    write_dataset(folder / "a", 12, seed=1)
    write_dataset(folder / "b", 4, seed=2)
    return Recipe(str(folder / "a"), str(folder / "b"), str(folder / "run"), backbone="mobilenetv3_small_050",
                  width=16, batch=4, steps=4, validate_every=2, workers=0)  # fmt: skip


def test_soft_argmax_of_one_hot_attention_is_the_centre_of_the_cell():
    attention = torch.zeros(1, 1, 6 * 8)
    attention[0, 0, 2 * 8 + 5] = 1.0
    mean, spread = soft_argmax(attention, 6, 8)
    np.testing.assert_allclose(mean[0, 0], [5.5 / 8, 2.5 / 6])
    np.testing.assert_allclose(spread, 0, atol=1e-7)
    # A stride-28 cell's centre in a 224 px image: 5.5 * 28 - 1/2.
    assert float(to_pixels(mean, 224)[0, 0, 0]) == pytest.approx(5.5 * 28 - 0.5)


def test_soft_argmax_moments_are_those_of_the_distribution():
    attention = torch.rand(2, 3, 20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    attention /= attention.sum(-1, keepdim=True)
    mean, spread = soft_argmax(attention, 4, 5)
    x = (np.arange(20) % 5 + 0.5) / 5
    p = attention[1, 2].numpy()
    assert float(mean[1, 2, 0]) == pytest.approx(p @ x)
    assert float(spread[1, 2, 0]) == pytest.approx(p @ (x - p @ x) ** 2)


@pytest.mark.parametrize(("half", "ratio"), [(True, 1.0), (False, 2**-0.5)], ids=["ours", "published"])
def test_the_half_on_the_logarithm_makes_sigma_right(half, ratio):
    # Minimise over one log-variance on errors of known sigma; the published loss ends at sigma / sqrt 2.
    errors = 3.0 * torch.randn(20_000, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    log_variance = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([log_variance], max_iter=100)

    def closure():
        optimizer.zero_grad()
        published = (0.5 * errors.square() / variance_px(log_variance) + variance_px(log_variance).log()).mean()
        loss = gaussian_nll(errors, log_variance) if half else published
        loss.backward()
        return loss

    optimizer.step(closure)
    sigma = float(variance_px(log_variance.detach()).sqrt())
    # The standard error of a standard deviation from N errors is sigma / sqrt(2 N): 0.5 % here.
    assert sigma == pytest.approx(3.0 * ratio, rel=4 * 0.005)


def test_crops_move_the_labels_with_the_picture():
    # A picture that is bright only at its corners' places: the crop is bright where the labels say.

    corners = np.array([[30.0, 70], [60, 72], [55, 31], [40, 30]])
    image = np.zeros((100, 100, 3), np.uint8)
    for u, v in corners.astype(int):
        image[v - 1 : v + 2, u - 1 : u + 2] = 255
    rng = np.random.default_rng(0)
    orders = set()
    for _ in range(30):
        warp = random_warp(corners, (100, 100), 224, rng)
        crop, moved = warp.cut(image), warp.apply(corners)
        near_left, near_right = moved[:2]
        assert near_left[0] < near_right[0]  # mirrored or not, left is left
        orders.add(bool(moved[3, 0] - near_left[0] > 0.3 * (near_right[0] - near_left[0])))
        for u, v in np.round(moved).astype(int):
            assert crop[v, u].min() > 150
    assert orders == {True, False}  # both the picture and its mirror image occur


def test_training_resumes_to_the_same_weights(recipe, tmp_path):
    whole = dataclasses.replace(recipe, out=str(tmp_path / "whole"))
    train(whole)
    halves = dataclasses.replace(recipe, out=str(tmp_path / "halves"))
    # Killed after the second step: what is on disk is the checkpoint of that validation.
    with pytest.MonkeyPatch.context() as patch:
        from shortfinal.train import fit

        save = fit.Run.save

        def killed(run, name):
            save(run, name)
            if name == "last.pt":
                raise KeyboardInterrupt

        patch.setattr(fit.Run, "save", killed)
        with pytest.raises(KeyboardInterrupt):
            train(halves)
    train(halves)
    one, other = (torch.load(tmp_path / n / "last.pt", weights_only=True) for n in ("whole", "halves"))
    assert one["step"] == other["step"] == 4
    for name, weight in one["net"].items():
        torch.testing.assert_close(weight, other["net"][name], rtol=1e-4, atol=1e-5)
    with (tmp_path / "halves" / "log.csv").open() as file:
        assert [int(float(row["step"])) for row in csv.DictReader(file)] == [2, 4]


def test_a_run_of_another_recipe_is_not_continued(recipe, tmp_path):
    train(dataclasses.replace(recipe, out=str(tmp_path), steps=2))
    with pytest.raises(sf.InputError, match="another learning_rate"):
        train(dataclasses.replace(recipe, out=str(tmp_path), steps=2, learning_rate=0.5))


def test_export_describes_itself_and_equals_torch(recipe, tmp_path):
    train(dataclasses.replace(recipe, out=str(tmp_path)))
    info = export(tmp_path / "best.pt", tmp_path / "model.onnx")
    assert compare(tmp_path / "model.onnx", load_network(tmp_path / "best.pt")[0], info.size, seed=5) < 1e-5
    detector = sf.KeypointDetector(tmp_path / "model.onnx")
    assert detector.info == info
    assert info.keypoints == sf.CORNER_NAMES
    assert "median_px" in info.figures
    with pytest.raises(sf.InputError, match="cannot be written"):
        export(tmp_path / "best.pt", tmp_path)
    text = (tmp_path / "model.onnx").read_bytes()
    assert str(tmp_path).encode() not in text  # no trace of where it was made
    assert b".py" not in text


def test_the_shipped_model_is_small():
    from shortfinal.detector import shipped_model

    assert shipped_model().stat().st_size < 12e6


def test_another_backbone_fits_too():
    net = KeypointNet("mobilenetv4_conv_small_035", width=16).eval()
    mean, log_variance = net(torch.zeros(1, 3, 64, 64))
    assert mean.shape == log_variance.shape == (1, 4, 2)
    assert ((mean > 0) & (mean < 1)).all()


@pytest.mark.parametrize("content", [None, b"nonsense"])
def test_what_is_no_checkpoint_is_refused(tmp_path, content):
    path = tmp_path / "x.pt"
    if content:
        path.write_bytes(content)
    with pytest.raises(sf.InputError, match=r"x\.pt: "):
        export(path, tmp_path / "y.onnx")
    assert not (tmp_path / "y.onnx").exists()


@pytest.mark.parametrize(
    ("backbone", "message"),
    [("nonsense", "'nonsense': Unknown model"), ("vit_tiny_patch16_224", "has the strides 16;")],
)
def test_a_backbone_that_does_not_do_is_named(backbone, message):
    with pytest.raises(sf.InputError, match=message):
        KeypointNet(backbone)


def test_a_checkpoint_that_lacks_something_is_refused(tmp_path):
    torch.save({"recipe": {}, "net": {}}, tmp_path / "x.pt")
    with pytest.raises(sf.InputError, match=r"x\.pt: not a complete checkpoint: lacks average, optimizer"):
        export(tmp_path / "x.pt", tmp_path / "y.onnx")


def test_a_loss_that_is_not_finite_ends_the_run(recipe, tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("shortfinal.train.fit.gaussian_nll", lambda error, log_variance: log_variance.mean() * np.nan)
        with pytest.raises(JobError, match="diverged at step 1; lower --learning-rate"):
            train(dataclasses.replace(recipe, out=str(tmp_path)))


def test_an_error_in_a_worker_is_one_line(recipe, tmp_path):
    write_dataset(tmp_path / "a", 1, seed=1)
    (tmp_path / "a" / "images" / "000000.png").write_bytes(b"no picture")
    with pytest.raises(sf.InputError, match=r"^[^\n]*000000\.png: cannot be read as an image$") as refusal:
        train(dataclasses.replace(recipe, data=str(tmp_path / "a"), out=str(tmp_path / "run"), workers=1))
    assert not str(refusal.value).startswith("shortfinal")
