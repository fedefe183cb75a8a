import numpy as np
import pytest
from small import labelled_folder

import shortfinal as sf
from shortfinal.errors import JobError

torch = pytest.importorskip("torch")

from torch.optim.swa_utils import AveragedModel  # noqa: E402

from shortfinal.train import export as module  # noqa: E402
from shortfinal.train.export import LIMITS, Difference, export, load_network, random_pictures  # noqa: E402
from shortfinal.train.fit import PARTS  # noqa: E402
from shortfinal.train.model import KeypointNet  # noqa: E402
from shortfinal.train.recipe import Recipe, to_dict  # noqa: E402

SIZE = 64


def checkpoint(path, keypoints=sf.CORNER_NAMES, sharp=300.0, **network):
    """Write one of a small network with random weights; its attention is `sharp`, and follows the picture."""
    recipe = Recipe(("/home/somebody/pictures",), backbone="mobilenetv3_small_050", features=(8, 16, 32), width=16,
                    size=SIZE, keypoints=keypoints, mean=(0.4, 0.5, 0.6), **network)  # fmt: skip
    torch.manual_seed(0)
    net = KeypointNet(
        recipe.backbone, len(keypoints), recipe.head, recipe.covariance, recipe.features, recipe.width,
        **{name: recipe.learn == name for name in PARTS},
    )  # fmt: skip
    with torch.no_grad():
        for name, weight in net.named_parameters():
            if name.startswith(("score", "spread", "correlation", "present", "fc")):
                weight *= sharp if name == "score.weight" else 3.0
        for name, value in net.state_dict().items():  # no two are alike after training
            if name.endswith(("bias", "running_mean")):
                value += 0.01 * torch.randn_like(value)
            elif value.is_floating_point() and value.dim() == 1:
                value *= 1 + 0.02 * torch.randn_like(value)
    average = AveragedModel(net)
    parts = {"net": net.state_dict(), "average": average.state_dict(), "optimizer": {}, "schedule": {}}
    history = [{"median_px": 9.0}, {"step": 4.0, "median_px": 1.5, "far_median_px": float("nan")}]
    torch.save(parts | {"step": 4, "history": history, "recipe": to_dict(recipe)}, path)
    return path


def answers(path, pictures):
    """mean (N, K, 2), cov (N, 2K, 2K), visible (N, K) and present (N,) as the file has them."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return session.run(["mean_px", "cov_px", "visible", "present"], {"image": pictures})


def told(path, pictures):
    """The same by torch, from the network itself; beside them its sigmas (N, K, 2)."""
    network, _ = load_network(path)
    with torch.inference_mode():
        p = network.net(torch.from_numpy(pictures))
    return p.mean_px, p.cov_px, p.visible.sigmoid(), p.present.sigmoid(), p.sigma_px


def alike(given, wanted):
    """Covariances in units of their sigmas. float32: 1e-5 of the side, in pixels; a thousandth of a correlation."""
    variance = np.diagonal(wanted[1], axis1=1, axis2=2)
    unit = [1.0, np.sqrt(variance[:, :, None] * variance[:, None, :]), 1.0, 1.0]
    for mine, true, one in zip(given, wanted, unit):
        np.testing.assert_allclose(np.asarray(mine) / one, np.asarray(true) / one, rtol=1e-4,
                                   atol=max(1e-5 * SIZE, 1e-3))  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def traced_once():
    """Tracing takes seconds: the same network is traced once."""
    trace, models = module.to_onnx, {}

    def to_onnx(network, size):
        key = tuple((name, weight.double().sum().item()) for name, weight in network.state_dict().items())
        models[key] = models.get(key) or trace(network, size)
        copy = type(models[key])()
        copy.CopyFrom(models[key])
        return copy

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "to_onnx", to_onnx)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("export")
    labelled_folder(path / "data", 32)
    checkpoint(path / "best.pt")
    return path


SEVEN = (*sf.CORNER_NAMES, "a", "b", "c")
NETWORKS = [
    pytest.param({"covariance": "full", "keypoints": SEVEN}, id="full-covariance-of-seven", marks=pytest.mark.slow),
    pytest.param({"covariance": "keypoint"}, id="covariance-of-each-keypoint", marks=pytest.mark.slow),
    pytest.param({"covariance": "full", "head": "fc"}, id="fc-head", marks=pytest.mark.slow),
    pytest.param({"head": "fc", "keypoints": SEVEN}, id="fc-head-of-seven", marks=pytest.mark.slow),
]


@pytest.mark.parametrize("network", NETWORKS)
def test_the_file_answers_as_torch_for_any_number_of_pictures(tmp_path, network):
    path = checkpoint(tmp_path / "best.pt", **network)
    info = export(path, tmp_path / "model.onnx")
    k = len(info.keypoints)
    for count in (1, 5):
        pictures = random_pictures(SIZE, count, seed=count)
        *wanted, sigma = told(path, pictures)
        given = answers(tmp_path / "model.onnx", pictures)
        assert [a.shape[1:] for a in given] == [(k, 2), (2 * k, 2 * k), (k,), ()]
        alike(given, wanted)
        variance = np.diagonal(given[1], axis1=1, axis2=2)
        np.testing.assert_allclose(np.sqrt(variance), sigma.flatten(1), rtol=1e-4)
        correlation = given[1] / np.sqrt(variance[:, :, None] * variance[:, None, :])
        assert (np.abs(np.tril(correlation, -1)).max() > 0.1) == (info.covariance != "diagonal")
    detector = sf.KeypointDetector(tmp_path / "model.onnx")
    assert detector.info == info
    detector.detect(np.zeros((SIZE, SIZE, 3), np.uint8), sf.PixelWindow(0, 0, SIZE, SIZE, SIZE, SIZE))
    alike(told(tmp_path / "model.onnx", pictures)[:-1], wanted)  # the file read as a checkpoint


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["fp32", "fp16"])
def test_where_runways_are_is_told_on_request(tmp_path, precision):
    path = checkpoint(tmp_path / "best.pt", learn="where", start="another.pt")
    export(path, tmp_path / "model.onnx", precision)
    detector = sf.KeypointDetector(tmp_path / "model.onnx")
    assert detector.searches
    import onnxruntime

    session = onnxruntime.InferenceSession(str(tmp_path / "model.onnx"), providers=["CPUExecutionProvider"])
    network, _ = load_network(path)
    for count in (1, 3):
        pictures = random_pictures(SIZE, count, seed=count)
        with torch.inference_mode():
            wanted = network(torch.from_numpy(pictures))[-1].numpy()
        (asked,) = session.run(["where"], {"image": pictures, "search": np.array(True)})
        assert asked.shape == wanted.shape == (count, 2, SIZE // 16, SIZE // 16)
        np.testing.assert_allclose(asked, wanted, rtol=1e-4 if precision == "fp32" else 0.02, atol=1e-3)
        (unasked,) = session.run(["where"], {"image": pictures})
        assert unasked.size == 0  # a look at a crop does not pay for it
    spots = detector.spots(np.zeros((SIZE, SIZE, 3), np.uint8), [sf.PixelWindow(0, 0, SIZE, SIZE, SIZE, SIZE)])
    assert spots == sorted(spots, reverse=True)


@pytest.mark.slow
def test_each_corner_is_looked_at_on_request(tmp_path, folder):
    path = checkpoint(tmp_path / "best.pt", learn="corners", covariance="full", start="another.pt")
    export(path, tmp_path / "model.onnx")
    import onnxruntime

    session = onnxruntime.InferenceSession(str(tmp_path / "model.onnx"), providers=["CPUExecutionProvider"])
    names = ["corner_px", "corner_cov_px", "corner_visible"]
    network, _ = load_network(path)
    nothing = np.empty((0, 3, SIZE, SIZE), np.float32)
    for count in (1, 3):
        patches = random_pictures(48, 4 * count, seed=count).reshape(count, 4, 3, 48, 48)
        with torch.inference_mode():
            wanted = network.net(torch.from_numpy(patches))
        mean, cov, visible = session.run(names, {"image": nothing, "patches": patches, "sharpen": np.array(True)})
        np.testing.assert_allclose(mean, wanted.mean_px, atol=1e-3)
        np.testing.assert_allclose(cov, wanted.cov_px, rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(visible, wanted.visible.sigmoid(), atol=1e-4)
    pictures = random_pictures(SIZE, 2, seed=3)
    assert [part.size for part in session.run(names, {"image": pictures})] == [0, 0, 0]
    alike(answers(tmp_path / "model.onnx", pictures), told(path, pictures)[:-1])  # the whole picture's as ever
    again, _ = load_network(tmp_path / "model.onnx")
    with torch.inference_mode():
        np.testing.assert_allclose(again.net(torch.from_numpy(patches)).mean_px, wanted.mean_px, atol=1e-3)


@pytest.mark.slow
def test_a_model_that_cannot_search_or_does_not_look_at_corners_says_so(folder, tmp_path):
    export(folder / "best.pt", tmp_path / "model.onnx")
    detector, image = sf.KeypointDetector(tmp_path / "model.onnx"), np.zeros((SIZE, SIZE, 3), np.uint8)
    assert not detector.searches
    with pytest.raises(sf.InputError, match="does not say where runways are"):
        detector.spots(image, [sf.PixelWindow(0, 0, SIZE, SIZE, SIZE, SIZE)])
    assert not detector.sharpens
    with pytest.raises(sf.InputError, match="does not look at corners"):
        detector.sharpened(image, sf.GaussianKeypoints.from_sigma(np.eye(4, 2), 1.0))


@pytest.mark.slow
def test_export_describes_itself(folder, tmp_path):
    info = export(folder / "best.pt", tmp_path / "model.onnx", data=folder / "data")
    assert sf.KeypointDetector(tmp_path / "model.onnx").info == info
    assert (info.keypoints, info.covariance, info.precision) == (sf.CORNER_NAMES, "diagonal", "fp32")
    assert (info.size, info.mean, info.calibration) == (SIZE, (0.4, 0.5, 0.6), None)
    assert info.training == {
        "data": ["pictures"], "steps": 4, "batch": 32, "seed": 0, "head": "sam", "features": [8, 16, 32], "width": 16
    }  # fmt: skip
    assert info.figures["median_px"] == 1.5  # of the last validation
    assert "far_median_px" not in info.figures  # JSON has no NaN
    content = (tmp_path / "model.onnx").read_bytes()
    for trace in (str(tmp_path), "/home", ".py"):  # of where it was made
        assert trace.encode() not in content


@pytest.mark.slow
def test_half_the_digits_in_the_backbone_only(folder, tmp_path):
    info = export(folder / "best.pt", tmp_path / "model.onnx", "fp16")
    assert sf.KeypointDetector(tmp_path / "model.onnx").info == info
    assert info.precision == "fp16"
    pictures = random_pictures(SIZE, 8, seed=4)
    mean, cov, *_ = answers(tmp_path / "model.onnx", pictures)
    true_mean, true_cov, *_ = told(folder / "best.pt", pictures)
    off = np.abs(mean - true_mean.numpy())
    assert 1e-5 < off.max() < 0.05
    assert not np.array_equal(mean, mean.astype(np.float16))  # coordinates are not rounded to it
    np.testing.assert_allclose(np.diagonal(cov, axis1=1, axis2=2), np.diagonal(true_cov, axis1=1, axis2=2), rtol=0.02)
    with pytest.raises(sf.InputError, match=r"model\.onnx: a model in fp16; only one in fp32 can be trained on"):
        load_network(tmp_path / "model.onnx")


def test_int8_loses_no_more_than_it_may(folder, tmp_path):
    info = export(folder / "best.pt", tmp_path / "model.onnx", "int8", folder / "data")
    assert sf.KeypointDetector(tmp_path / "model.onnx").info == info
    assert info.precision == "int8"
    assert 0 < info.figures["int8_share"] <= 1
    assert 1e-4 < info.figures["export_mean_px"] <= LIMITS["int8"].mean_px
    import onnx

    graph = onnx.load(tmp_path / "model.onnx").graph
    eight_bit = {t.name for t in graph.initializer if t.data_type == onnx.TensorProto.INT8}
    assert any("backbone" in name for name in eight_bit)
    assert not any(part in name for name in eight_bit for part in ("net.neck", "net.score", "net.spread"))


@pytest.mark.slow
def test_int8_that_loses_more_is_not_offered(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(LIMITS, "int8", Difference(1e-5, 1.0, 1.0))
    message = (
        r"in int8 it differs from torch by \S+ px, \S+ of sigma, \S+ of probability; allowed are 1e-05 px, .*written"
    )
    with pytest.raises(JobError, match=message):
        export(folder / "best.pt", tmp_path / "model.onnx", "int8", folder / "data")
    assert not (tmp_path / "model.onnx").exists()


@pytest.mark.parametrize("part", ["score.weight", "spread.0.2.bias", "present.2.bias"])
def test_a_file_that_differs_from_torch_is_not_written(folder, tmp_path, monkeypatch, part):
    from onnx import numpy_helper

    trace = module.to_onnx

    def another(network, size):
        model = trace(network, size)
        (weight,) = (t for t in model.graph.initializer if t.name.endswith(part))
        weight.CopyFrom(
            numpy_helper.from_array(np.float32(1.01) * numpy_helper.to_array(weight) + np.float32(0.01), weight.name)
        )
        return model

    monkeypatch.setattr(module, "to_onnx", another)
    with pytest.raises(JobError, match="in fp32 it differs from torch"):
        export(folder / "best.pt", tmp_path / "model.onnx")
    assert not (tmp_path / "model.onnx").exists()


@pytest.mark.parametrize("content", [None, b"nonsense"])
def test_what_is_no_checkpoint_is_refused(tmp_path, content):
    path = tmp_path / "x.pt"
    if content:
        path.write_bytes(content)
    with pytest.raises(sf.InputError, match=r"x\.pt: "):
        export(path, tmp_path / "y.onnx")
    assert not (tmp_path / "y.onnx").exists()


def test_a_checkpoint_that_lacks_something_is_refused(tmp_path):
    torch.save({"recipe": {}, "net": {}}, tmp_path / "x.pt")
    with pytest.raises(sf.InputError, match=r"x\.pt: not a complete checkpoint: lacks average, optimizer"):
        export(tmp_path / "x.pt", tmp_path / "y.onnx")


def test_weights_of_another_network_are_refused(folder, tmp_path):
    state = torch.load(folder / "best.pt", weights_only=True)
    state["recipe"]["width"] = 24
    torch.save(state, tmp_path / "x.pt")
    with pytest.raises(sf.InputError, match=r"x\.pt: its weights are not those of the network in its recipe"):
        export(tmp_path / "x.pt", tmp_path / "y.onnx")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("model.onnx", "int4"), "precision: 'int4'; expected one of fp32, fp16, int8"),
        (("model.onnx", "int8"), "int8 needs a data set"),
        (("absent/model.onnx",), "no such folder .*absent; make it first"),
        (("",), "cannot be written: Is a directory"),
        (("model.onnx", "int8", "few"), "few: 15 runways; at least 16 are needed"),
        (("model.onnx", "fp32", "nowhere"), "nowhere: no such folder"),
    ],
)
def test_what_cannot_be_exported_is_refused(folder, tmp_path, arguments, message):
    labelled_folder(tmp_path / "few", 15)
    out, precision, data = (*arguments, "fp32", None)[:3] if len(arguments) == 1 else (*arguments, None)[:3]
    with pytest.raises(sf.InputError, match=message):
        export(folder / "best.pt", tmp_path / out, precision, data and tmp_path / data)
    assert not (tmp_path / "model.onnx").exists()
