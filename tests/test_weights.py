from pathlib import Path

import cv2
import numpy as np
import pytest

import shortfinal as sf
from shortfinal.data.image import read_image

torch = pytest.importorskip("torch")

from shortfinal.train import timm  # noqa: E402
from shortfinal.train.weights import load_folded_mobilenet, load_weights, settle_batch_norm  # noqa: E402

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
FOLDED = DATA / "weights" / "tf2_mobilenet_v2_1.0_224_ptq_float32.npz"
needs_data = pytest.mark.skipif(not FOLDED.is_file(), reason="shared/data is not here: no pretrained MobileNetV2")
# In the file's numbering, which puts the background before ImageNet's 1000 classes.
UNIFORM = 653  # military uniform
LANDSCAPE = slice(971, 982)  # alp, bubble, cliff, coral reef, geyser, lakeside, promontory, ..., valley, volcano


def inputs(pictures, mean=127.5, std=127.5):
    """What the network was trained on: 224 px, (RGB - 127.5) / 127.5."""
    small = [cv2.resize(picture, (224, 224), interpolation=cv2.INTER_AREA) for picture in pictures]
    return torch.from_numpy(((np.stack(small) - mean) / std).astype(np.float32).transpose(0, 3, 1, 2).copy())


def mobilenet(**options):
    return timm.create_model("mobilenetv2_100", **{"num_classes": 1001, "pad_type": "same"} | options).eval()


@pytest.fixture(scope="module")
def trained():
    model = mobilenet()
    load_folded_mobilenet(model, FOLDED)
    return model


@pytest.fixture(scope="module")
def officer():
    """Grace Hopper in uniform, as matplotlib ships her."""
    matplotlib = pytest.importorskip("matplotlib")
    return read_image(Path(matplotlib.get_data_path()) / "sample_data" / "grace_hopper.jpg")


@pytest.fixture(scope="module")
def aerial():
    """Approaches at two airports, one by the sea, one in hills: without the watermarks at the border."""
    return [read_image(path)[140:500, 140:500] for path in sorted((DATA / "lard_sample" / "images").iterdir())[::6]]


def chances(model, batch):
    with torch.inference_mode():
        return model(batch).softmax(dim=1)


@needs_data
def test_the_file_classifies(trained, officer, aerial):
    """No picture of ImageNet is here; these it has not seen. By chance the two figures were 0.001 and 0.011."""
    seen = chances(trained, inputs([officer]))[0]
    assert int(seen.argmax()) == UNIFORM
    assert float(seen[UNIFORM]) > 0.7
    assert float(chances(trained, inputs(aerial))[:, LANDSCAPE].sum(dim=1).mean()) > 0.3


def swapped(model):
    """Two layers of the same shape in each other's place."""
    one, other = model.blocks[2][1].conv_pwl, model.blocks[2][2].conv_pwl
    kept = one.weight.clone()
    one.weight.copy_(other.weight)
    other.weight.copy_(kept)


def without_bias(model):
    model.bn1.bias.zero_()


def transposed(model):
    """Height for width in every depthwise kernel."""
    for module in model.modules():
        if isinstance(module, torch.nn.Conv2d) and module.groups > 1:
            module.weight.copy_(module.weight.transpose(2, 3).clone())


def other_norm(model):
    """The statistics of a batch norm that is folded in already, counted once more."""
    for module in model.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_var.fill_(0.5)


@needs_data
@pytest.mark.parametrize("wrong", [swapped, without_bias, transposed, other_norm])
def test_a_wrong_load_does_visibly_worse(officer, wrong):
    model = mobilenet()
    load_folded_mobilenet(model, FOLDED)
    with torch.no_grad():
        wrong(model)
    assert float(chances(model, inputs([officer]))[0, UNIFORM]) < 0.4


@needs_data
def test_so_does_another_padding_or_normalisation(trained, officer, aerial):
    symmetric = mobilenet(pad_type="")
    load_folded_mobilenet(symmetric, FOLDED)
    assert float(chances(symmetric, inputs([officer]))[0, UNIFORM]) < 0.4
    assert float(chances(symmetric, inputs(aerial))[:, LANDSCAPE].sum(dim=1).mean()) < 0.2
    for mean, std in ((127.5, 63.75), (0, 255), (115, 57)):
        assert float(chances(trained, inputs([officer], mean, std))[0, UNIFORM]) < 0.5


@needs_data
def test_a_model_cut_short_takes_what_it_has(trained, officer):
    backbone = mobilenet(num_classes=0, features_only=True)
    load_folded_mobilenet(backbone, FOLDED)
    with torch.inference_mode():
        maps = backbone(inputs([officer]))
        whole = trained.forward_intermediates(inputs([officer]), intermediates_only=True)
    for one, other in zip(maps, whole, strict=True):
        assert torch.equal(one, other)


def spread(model, batch):
    """The model's output for a batch in evaluation and in training."""
    with torch.no_grad():
        still, moving = model.eval()(batch), model.train()(batch)
    model.eval()
    return still, moving


@needs_data
def test_settling_changes_nothing_but_what_training_starts_from(trained, aerial):
    batch = torch.nn.functional.interpolate(inputs(aerial), size=(96, 96), mode="area")
    half, model = batch[::2], mobilenet()
    model.load_state_dict(trained.state_dict())
    before, off = spread(model, half)
    model.load_state_dict(trained.state_dict())
    settle_batch_norm(model, batch)
    assert not model.training
    settled = {name: value.clone() for name, value in model.state_dict().items()}
    after, moving = spread(model, half)
    # As far from what double precision says as it was: what float32 leaves of 53 layers.
    exact = mobilenet().double()
    exact.load_state_dict(trained.state_dict())
    with torch.no_grad():
        true, whole = exact(half.double()), exact(batch.double())
    rounding = (before - true).abs().max()
    assert (after - true).abs().max() < 4 * rounding
    # Training on half of the pictures it was settled on begins near that, before it would have far from it;
    assert (off - before).norm() > before.norm()
    assert (moving - after).norm() < 0.4 * before.norm()
    # on all of them it begins there, as the batch's statistics are the settled ones.
    model.load_state_dict(settled)
    assert (spread(model, batch)[1] - whole).abs().max() < 4 * rounding


def small(**options):
    torch.manual_seed(options.pop("seed", 0))
    return timm.create_model(options.pop("name", "test_efficientnet"), **options).eval()


@pytest.mark.parametrize("name", ["test_efficientnet", "test_convnext", "test_vit"])
@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_saved_weights_of_timms_whole_model_load_into_the_backbone(tmp_path, name, suffix):
    whole, backbone = small(seed=1, name=name), small(seed=2, name=name, features_only=True)
    path = tmp_path / f"weights{suffix}"
    if suffix == ".pt":
        torch.save({"state_dict": whole.state_dict()} if name == "test_vit" else whole.state_dict(), path)
    else:
        from safetensors.torch import save_file

        save_file(whole.state_dict(), path)
    batch = torch.randn(2, 3, 160, 160, generator=torch.Generator().manual_seed(3))
    with torch.inference_mode():
        wanted = whole.forward_intermediates(batch, intermediates_only=True)[-1]
        assert not torch.equal(backbone(batch)[-1], wanted)
        load_weights(backbone, path, batch)
        torch.testing.assert_close(backbone(batch)[-1], wanted)


def shifted_layers(tmp_path):
    """A file that begins with the second layer."""
    with np.load(FOLDED) as content:
        names = sorted(content.files)[2:]
        np.savez(tmp_path / "x.npz", **{name: content[name] for name in names})


def cut(tmp_path):
    whole = FOLDED.read_bytes()
    (tmp_path / "x.npz").write_bytes(whole[: len(whole) // 2])


def spoilt_inside(tmp_path):
    content = bytearray(FOLDED.read_bytes())
    content[200_000:300_000] = bytes(100_000)
    (tmp_path / "x.npz").write_bytes(content)


def few(tmp_path):
    np.savez(tmp_path / "x.npz", **{"000_w": np.zeros((8, 3, 3, 3), np.float32), "000_b": np.zeros(8, np.float32)})


def bare(tmp_path):
    with (tmp_path / "x.npz").open("wb") as file:
        np.save(file, np.zeros(3))


def flat(tmp_path):
    with np.load(FOLDED) as content:
        np.savez(tmp_path / "x.npz", **{n: content[n].ravel() if n.endswith("_w") else content[n] for n in content})


@needs_data
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda folder: None, "cannot read the weights: No such file or directory"),
        (lambda folder: (folder / "x.npz").write_bytes(b""), "cannot read the weights: "),
        (lambda folder: (folder / "x.npz").write_bytes(b"nonsense"), "cannot read the weights: "),
        (cut, "cannot read the weights: "),
        (spoilt_inside, "cannot read the weights: "),
        (bare, "cannot read the weights: "),
        (few, "holds 1 layers; the network has 53"),
        (shifted_layers, r"layer 0 is \(32, 3, 3, 1\)|holds 5\d layers; the network has 53"),
        (flat, r"layer 0 is \(864,\); the network's is \(32, 3, 3, 3\)"),
    ],
)
def test_a_folded_file_of_no_use_is_one_line(tmp_path, spoil, message):
    spoil(tmp_path)
    model = mobilenet()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    with pytest.raises(sf.InputError, match=rf"x\.npz: ({message})") as refusal:
        load_weights(model, tmp_path / "x.npz", torch.zeros(1, 3, 64, 64))
    assert "\n" not in str(refusal.value)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


@pytest.mark.slow
@needs_data
def test_the_folded_file_is_of_one_network():
    for name, message in (("test_efficientnet", "layer 0 is"), ("test_vit", "holds 53 layers; the network has")):
        with pytest.raises(sf.InputError, match=f"npz: {message}"):
            load_weights(small(name=name), FOLDED, torch.zeros(1, 3, 160, 160))


@pytest.mark.parametrize("name", ["x.pt", "x.safetensors"])
@pytest.mark.parametrize("content", [None, b"", b"nonsense"])
def test_a_file_that_is_none_of_weights_is_one_line(tmp_path, name, content):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(sf.InputError, match=rf"{name}: (cannot read the weights|not a file of weights): \S") as refusal:
        load_weights(small(), tmp_path / name, torch.zeros(1, 3, 64, 64))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ([1, 2], "holds no tensors by name"),
        (
            {"step": 3, "net": {"x": torch.zeros(1)}},
            "holds no tensors by name; expected the state_dict of a timm model",
        ),
        ({"conv1.weight": torch.zeros(3)}, r"fits \d+ of the backbone's \d+ tensors, not conv_stem\.weight; is it of"),
    ],
)
def test_weights_of_something_else_are_refused(tmp_path, state, message):
    torch.save(state, tmp_path / "x.pt")
    with pytest.raises(sf.InputError, match=rf"x\.pt: {message}"):
        load_weights(small(), tmp_path / "x.pt", torch.zeros(1, 3, 64, 64))


def test_weights_that_lack_one_tensor_are_refused(tmp_path):
    state = small(seed=1).state_dict()
    del state["bn1.running_var"]
    torch.save(state, tmp_path / "x.pt")
    with pytest.raises(sf.InputError, match=r"not bn1\.running_var"):
        load_weights(small(), tmp_path / "x.pt", torch.zeros(1, 3, 64, 64))
