import copy
import getpass
import hashlib
import json
import os
import shutil
import socket
import subprocess
from dataclasses import asdict

import numpy as np
import pytest
from small import INFO, constant_model

import shortfinal as sf
from shortfinal.detector import described, shipped_model
from shortfinal.evaluate import pack
from shortfinal.evaluate.card import CARD_KEY, card_of, model_card, with_card, without_card
from shortfinal.evaluate.pack import verify_manifest, write_manifest

CARD = "# Model card\n\nσ is | honest: «ja».\n" + "It is long. " * 50


def figure(name, value, low, high, by="all", group="all", count=800, unit=""):
    return {"by": by, "group": group, "name": name, "value": value, "low": low, "high": high, "count": count,
            "unit": unit}  # fmt: skip


REQUIREMENT = {
    "id": "R1", "text": "", "metric": "error_px.median", "where": "all", "bound": "at most 0.6", "value": 0.5,
    "low": 0.4, "high": 0.7, "count": 800, "unit": "px", "result": "not shown", "why": "reaches beyond at most 0.6",
}  # fmt: skip
EVIDENCE = {
    "format": 1, "title": "held out", "created": "2025-01-02T03:04:05+00:00", "version": sf.__version__,
    "subject": {"kind": "model", "name": "m.onnx", "sha256": "", "sigma": "the network's own",
                "model": {**asdict(INFO), "training": {"data": ["scenes"], "steps": 800}, "calibration": None}},
    "data": {"name": "held-out", "format": "labels.csv", "pictures": 3, "labels": 100,
             "airports": {"AAAA": 60, "BBBB": 40}, "sha256": "ab"},
    "settings": {"false_alarm_rate": 1e-3, "integrity_risk": 1e-7, "fault_prior": 1e-4, "alert_limits_m": None},
    "counts": {"labels": 100, "predicted": 98, "missing": 2, "unmatched": 0, "problems": {"image": 2},
               "decisions": {"use": 90, "do-not-use": 8, "missing": 2}},
    "problems": [], "notes": ["LFST's labels lie beside the paint"],
    "metrics": [
        figure("error_px.median", 0.5, 0.4, 0.6, unit="px"), figure("coverage.95", 0.94, 0.93, 0.96),
        figure("coverage.50", 0.6, 0.58, 0.62), figure("use", 0.9, 0.82, 0.95, count=100),
        figure("over_level", 0.0, 0.0, 0.036, count=100), figure("do_not_use", 0.08, 0.04, 0.15, count=100),
        figure("error_px.median", 0.4, 0.3, 0.5, "airport", "AAAA", 480, "px"),
        figure("error_px.median", 0.8, 0.7, 0.9, "airport", "BBBB", 320, "px"),
        figure("error_px.median", 0.9, None, None, "airport", "CCCC", 8, "px"),
        figure("coverage.95", 0.99, 0.98, 1.0, "distance", "0–500 m"),
        figure("coverage.95", 0.93, 0.90, 0.95, "distance", "500–1000 m"),
        figure("use", 0.9, 0.8, 0.95, "light", "bright", 100),
    ],
    "calibration": {"nominal": [0.5, 0.9], "observed": [0.6, 0.88], "low": [0.58, 0.85], "high": [0.62, 0.91]},
    "requirements": [REQUIREMENT], "compare": None,
}  # fmt: skip


def evidence_of(model, **changes):
    evidence = copy.deepcopy(EVIDENCE) | changes
    evidence["subject"] |= {"sha256": hashlib.sha256(model.read_bytes()).hexdigest()}
    return evidence


@pytest.fixture
def case(tmp_path):
    """A model, data with three pictures of which one is missing, requirements, and a folder of results."""
    data, out = tmp_path / "data", tmp_path / "out"
    (data / "images").mkdir(parents=True)
    (out / "figures").mkdir(parents=True)
    for n, name in enumerate(("a.png", "b\\\n.png")):
        (data / "images" / name).write_bytes(bytes([n]) * 9)
    (data / "labels.csv").write_text("image\n")
    (out / "report.html").write_text("<html>")
    (out / "figures" / "error.png").write_bytes(b"png")
    (tmp_path / "requirements.toml").write_text("# none")
    model = constant_model(tmp_path / "m.onnx")
    evidence = evidence_of(model)
    (out / "evaluation.json").write_text(json.dumps(evidence))
    return {
        "out": out, "evidence": evidence, "subject": model, "data": data, "labels": [data / "labels.csv"],
        "pictures": [data / "images" / name for name in ("b\\\n.png", "a.png", "gone.png")],
        "requirements": tmp_path / "requirements.toml", "seeds": {"bootstrap": 0},
    }  # fmt: skip


def write(case, **changes):
    return write_manifest(**{**case, **changes})


def verify(case):
    path = case["out"] / "manifest.json"
    return verify_manifest(path, **{name: case[name] for name in ("subject", "data", "requirements")})


def test_the_manifest_names_everything_by_its_digest(case):
    seen = []
    manifest = json.loads(write(case, progress=seen.append).read_text())
    assert verify(case) == []
    digest = hashlib.sha256(case["subject"].read_bytes()).hexdigest()
    assert manifest["subject"] == {
        "kind": "model", "name": "m.onnx", "sha256": digest, "bytes": case["subject"].stat().st_size,
        "sigma": "the network's own", "sha256_without_card": digest,
    }  # fmt: skip
    names = ["evaluation.json", "figures/error.png", "pictures.sha256", "report.html"]
    assert [entry["file"] for entry in manifest["files"]] == names
    assert manifest["files"][-1] == {
        "file": "report.html", "sha256": hashlib.sha256(b"<html>").hexdigest(), "bytes": 6,
    }  # fmt: skip
    assert [entry["file"] for entry in manifest["data"]["labels"]] == ["labels.csv"]
    pictures = manifest["data"]["pictures"]
    listed = (case["out"] / "pictures.sha256").read_bytes()
    assert pictures == {
        "count": 2, "bytes": 18, "sha256": hashlib.sha256(listed).hexdigest(), "list": "pictures.sha256",
        "missing": 1, "missing_names": ["images/gone.png"],
    }  # fmt: skip
    assert seen == [1, 2, 3]
    assert manifest["requirements_file"]["sha256"] == hashlib.sha256(b"# none").hexdigest()
    assert manifest["passed"] is False
    assert [manifest[name] for name in ("metrics", "requirements", "settings", "seeds")] == [
        EVIDENCE["metrics"], [REQUIREMENT], EVIDENCE["settings"], {"bootstrap": 0},
    ]  # fmt: skip
    environment = manifest["environment"]
    assert environment["packages"]["numpy"] == np.__version__
    assert (environment["cpus"], manifest["code"]["version"]) == (os.cpu_count(), sf.__version__)


def test_the_same_again_is_the_same_file(case):
    first = write(case).read_bytes()
    assert write(case, pictures=case["pictures"][::-1]).read_bytes() == first


def test_it_tells_nothing_of_the_machine(case, monkeypatch):
    monkeypatch.setattr(pack.platform, "node", lambda: pytest.fail("the host's name"))
    outside = case["data"].parent / "outside.csv"
    outside.write_text("image\n")
    text = write(case, labels=[*case["labels"], outside]).read_text()
    names = [entry["file"] for entry in json.loads(text)["data"]["labels"]]
    assert names == ["labels.csv", "outside.csv"]
    for private in (str(case["out"].parent), str(pack.__file__), os.path.expanduser("~/"), socket.gethostname()):
        assert private not in text
    assert f'"{getpass.getuser()}"' not in text
    assert "/home" not in text + (case["out"] / "pictures.sha256").read_text()


def change(path):
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("name", "of"),
    [
        ("report.html", "out"), ("figures/error.png", "out"), ("evaluation.json", "out"), ("labels.csv", "data"),
        ("images/a.png", "data"), ("images/b\\\n.png", "data"),
    ],
)  # fmt: skip
def test_a_changed_byte_and_a_removed_file_are_noticed(case, name, of):
    write(case)
    path = case[of] / name
    if name == "evaluation.json":  # another file of the same content
        path.write_bytes(path.read_bytes() + b" ")
    else:
        change(path)
    assert verify(case) == [f"{name}: changed"]
    path.unlink()
    assert verify(case) == [f"{name}: missing"]


@pytest.mark.parametrize("name", ["subject", "requirements"])
def test_another_model_or_other_requirements_are_noticed(case, name):
    write(case)
    if name == "subject":
        constant_model(case[name], cov=2 * np.eye(8))
    else:
        change(case[name])
    assert verify(case) == [f"{case[name].name}: changed"]
    case[name].unlink()
    assert verify(case) == [f"{case[name].name}: missing"]
    assert verify_manifest(case["out"] / "manifest.json") == []  # what is not given is not looked at


def test_a_model_with_a_card_counts_as_the_one_that_was_evaluated(case):
    write(case)
    case["subject"].write_bytes(with_card(case["subject"].read_bytes(), CARD))
    assert verify(case) == []
    manifest = write(case, evidence=evidence_of(case["subject"]))
    told = json.loads(manifest.read_text())["subject"]
    assert told["sha256"] != told["sha256_without_card"]
    case["subject"].write_bytes(without_card(case["subject"].read_bytes()))
    assert hashlib.sha256(case["subject"].read_bytes()).hexdigest() == told["sha256_without_card"]
    assert verify(case) == []


@pytest.mark.parametrize("name", ["metrics", "requirements"])
def test_figures_that_are_not_those_of_the_evaluation_are_noticed(case, name):
    path = write(case)
    manifest = json.loads(path.read_text())
    manifest[name][0]["value"] = 0.1
    path.write_text(json.dumps(manifest))
    assert verify(case) == [f"manifest.json: its {name} are not those of evaluation.json"]


def test_a_manifest_does_not_lead_out_of_its_folder(case):
    path = write(case)
    manifest = json.loads(path.read_text())
    manifest["files"] = [{"file": name, "sha256": ""} for name in ("../m.onnx", "/etc/hostname")]
    path.write_text(json.dumps(manifest))
    assert verify_manifest(path) == [f"{n}: not a name within the folder" for n in ("../m.onnx", "/etc/hostname")]


@pytest.mark.parametrize(
    "content", ["[]", "{}", "3", '{"format": 1}', '{"format": 2, "files": []}', '{"format": 1, "files": 3}']
)
def test_what_is_no_manifest_is_refused(tmp_path, content):
    path = tmp_path / "manifest.json"
    path.write_text(content)
    with pytest.raises(sf.InputError, match=r"manifest\.json: not a manifest of format 1; expected one that"):
        verify_manifest(path)
    with pytest.raises(sf.InputError, match="cannot read the manifest: No such file"):
        verify_manifest(tmp_path / "absent.json")


def test_predictions_without_pictures_or_requirements(case):
    write(case)
    evidence = case["evidence"]
    evidence["subject"] |= {"kind": "predictions", "model": None}
    evidence["requirements"] = None
    (case["out"] / "evaluation.json").write_text(json.dumps(evidence))
    manifest = json.loads(write(case, pictures=[], requirements=None).read_text())
    assert manifest["data"]["pictures"] is None
    assert (manifest["requirements_file"], manifest["passed"]) == (None, None)
    assert "sha256_without_card" not in manifest["subject"]
    assert not (case["out"] / "pictures.sha256").exists()  # of the evaluation before
    assert verify(case) == ["requirements.toml: no requirements were used"]


def test_passed_only_if_every_requirement_is_shown(case):
    case["evidence"]["requirements"] = [{**REQUIREMENT, "result": "shown"}]
    assert json.loads(write(case).read_text())["passed"] is True


def test_a_model_that_changed_meanwhile_fails_and_a_missing_label_file_is_refused(case):
    with pytest.raises(sf.InputError, match=r"absent\.csv: cannot be read: No such file"):
        write(case, labels=["absent.csv"])
    constant_model(case["subject"], cov=2 * np.eye(8))
    with pytest.raises(RuntimeError, match=r"m\.onnx: changed since it was evaluated; evaluate it again"):
        write(case)
    assert not (case["out"] / "manifest.json").exists()


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_the_commit_is_of_the_package_and_of_no_other_repository(tmp_path, monkeypatch):
    def git(*arguments):
        who = ["-c", "user.name=n", "-c", "user.email=e@example.org", "-c", "commit.gpgsign=false"]
        done = subprocess.run(["git", *who, *arguments], cwd=tmp_path, check=True, capture_output=True, text=True)
        return done.stdout.strip()

    module = tmp_path / "shortfinal" / "evaluate" / "pack.py"
    module.parent.mkdir(parents=True)
    module.write_text("")
    (tmp_path / "shortfinal" / "__init__.py").write_text("")
    monkeypatch.setattr(pack, "__file__", str(module))
    git("init")
    (tmp_path / "other").write_text("")
    git("add", "other")
    git("commit", "-m", "other")
    nothing = pack._code("1")
    assert (nothing["commit"], nothing["dirty"]) == (None, None)  # in a repository, but none of its files
    git("add", ".")
    git("commit", "-m", "package")
    clean = pack._code("1")
    assert (clean["commit"], clean["dirty"]) == (git("rev-parse", "HEAD"), False)
    module.write_text("x = 1")
    dirty = pack._code("1")
    assert (dirty["commit"], dirty["dirty"]) == (clean["commit"], True)
    assert dirty["sha256"] != clean["sha256"]


@pytest.mark.skipif(shutil.which("sha256sum") is None, reason="needs sha256sum")
def test_the_list_of_pictures_is_one_that_sha256sum_reads(case):
    write(case)
    arguments = ["sha256sum", "--check", "--strict", "--quiet", str(case["out"] / "pictures.sha256")]
    assert subprocess.run(arguments, cwd=case["data"]).returncode == 0
    change(case["data"] / "images" / "b\\\n.png")
    assert subprocess.run(arguments, cwd=case["data"], capture_output=True).returncode == 1


# The card in the model file


def test_a_card_in_the_shipped_model(tmp_path):
    import onnxruntime

    model, path = shipped_model().read_bytes(), tmp_path / "m.onnx"
    first = with_card(model, "another")
    path.write_bytes(with_card(first, CARD))
    assert card_of(model) is None
    assert card_of(path.read_bytes()) == CARD
    assert without_card(path.read_bytes()) == model
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    assert session.get_modelmeta().custom_metadata_map[CARD_KEY] == CARD
    plain, carded = sf.KeypointDetector(threads=1), sf.KeypointDetector(path, threads=1)
    assert carded.info == plain.info
    image = np.random.default_rng(0).integers(0, 256, (224, 224, 3), dtype=np.uint8)
    window = sf.PixelWindow(0, 0, 224, 224, 224, 224)
    np.testing.assert_array_equal(carded.detect(image, window).mean_px, plain.detect(image, window).mean_px)


def test_onnx_reads_the_card_and_a_new_description_leaves_it_out(tmp_path):
    onnx = pytest.importorskip("onnx")
    model = with_card(constant_model(tmp_path / "m.onnx").read_bytes(), CARD)
    read = onnx.load_from_string(model)
    onnx.checker.check_model(read)
    assert {entry.key: entry.value for entry in read.metadata_props}[CARD_KEY] == CARD
    assert card_of(read.SerializeToString()) == CARD  # in whatever order another program writes it
    assert card_of(described(model, INFO)) is None


def test_what_is_no_model_of_ours_gets_no_card(tmp_path):
    good = constant_model(tmp_path / "m.onnx").read_bytes()
    for content, message in [
        (b"hello", "model: not an ONNX model"),
        (good[:-1], "model: not an ONNX model"),
        (b"\xff" * 9, "model: not an ONNX model"),
        (b"", "model: not one of ours: no 'shortfinal' metadata"),
        (constant_model(tmp_path / "n.onnx", metadata={}).read_bytes(), "model: not one of ours"),
        (constant_model(tmp_path / "n.onnx", metadata={"shortfinal": "{}"}).read_bytes(), "model: its .* lacks format"),
    ]:
        with pytest.raises(sf.InputError, match=message):
            with_card(content, CARD)
    with pytest.raises(sf.InputError, match="card: it is empty"):
        with_card(good, " \n")


# What the card says


def parts_of(card):
    return {part.partition("\n")[0]: part.partition("\n")[2] for part in card.split("\n## ")}


def test_the_card_has_the_parts_of_a_model_card():
    parts = parts_of(model_card(EVIDENCE))
    assert list(parts) == [
        "# Model card: m.onnx", "What it is", "Intended use", "Out of scope", "Training data", "Evaluation data",
        "Figures", "Calibration", "Limitations found in the data", "What must not be concluded",
    ]  # fmt: skip
    assert "| backbone | constants |" in parts["What it is"]
    assert "does not hold; of light: night, dim." in parts["Out of scope"]
    assert "| data | scenes |" in parts["Training data"]
    assert "| airports | AAAA (60), BBBB (40) |" in parts["Evaluation data"]
    assert "| left out or doubtful | 2 image |" in parts["Evaluation data"]
    assert "| error_px.median | 0.5 px | 0.4 to 0.6 | 800 |" in parts["Figures"]
    assert "| over_level | 0 % | 0 % to 3.6 % | 100 |" in parts["Figures"]
    assert "| BBBB | 0.8 px (0.7 to 0.9) |" in parts["Figures"]
    assert "| CCCC | 0.9 px (too few to say) |" in parts["Figures"]
    assert "| 50 % | 60 % | 58 % to 62 % | +10.0 points |" in parts["Calibration"]
    assert "Farthest off at 50 %: 60 % found, too cautious." in parts["Calibration"]


def test_the_card_names_the_worst_groups():
    text = parts_of(model_card(EVIDENCE))["Limitations found in the data"]
    # CCCC's estimate is worse, but of one runway; BBBB's interval lies above that of all.
    assert "| error_px.median | airport: BBBB | 0.8 px | 0.7 to 0.9 | 0.5 px | yes |" in text
    assert "| coverage.95 | distance: 500–1000 m | 93 % | 90 % to 95 % | 94 % | no |" in text
    assert "light: " not in text  # one group is not worse than itself
    assert "- 2 of 100 labelled runways have no prediction." in text
    assert "- 8 % of the runways are refused." in text
    assert "- Requirement R1 (error_px.median, all) not shown: reaches beyond at most 0.6." in text
    assert "- LFST's labels lie beside the paint" in text


def test_the_card_says_what_must_not_be_concluded():
    text = parts_of(model_card(EVIDENCE))["What must not be concluded"]
    assert "never exceed their protection levels: 100 rows without one do not exclude 3.6 %." in text
    assert "the data holds no true poses" in text
    assert "sigma is honest" not in text
    evidence = copy.deepcopy(EVIDENCE)
    evidence["metrics"] = [figure("along_m.q95", 9.0, 8.0, 10.0, unit="m")]
    evidence["subject"] |= {"sigma": "fitted here, not predicted"}
    text = parts_of(model_card(evidence))["What must not be concluded"]
    assert "protection levels" not in text
    assert "no true poses" not in text
    assert "That sigma is honest: it was fitted to these very errors" in text


def test_a_card_of_predictions_with_next_to_no_figures():
    evidence = copy.deepcopy(EVIDENCE) | {"metrics": [], "requirements": None, "notes": []}
    evidence["subject"] |= {"kind": "predictions", "name": "a|b <i>\n.csv", "model": None}
    evidence["calibration"] = {"nominal": [0.5], "observed": [None], "low": [None], "high": [None]}
    evidence["data"]["airports"] = {f"A{n:03}": 1 for n in range(20)}
    card = model_card(evidence)
    parts = parts_of(card)
    assert card.startswith("# Model card: a\\|b &lt;i> .csv\n")
    assert "Predictions made elsewhere" in parts["What it is"]
    assert "does not hold; of their light nothing is known." in parts["Out of scope"]
    assert parts["Training data"].strip() == "Not known."
    assert "No errors to hold it against." in parts["Calibration"]
    assert "No groups to compare" in parts["Limitations found in the data"]
    assert "A011 (1) and 8 more |" in parts["Evaluation data"]
    assert "None" not in card
    assert "nan" not in card
