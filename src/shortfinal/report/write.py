"""An evaluation as a folder: record, tables, pictures, page, model card, and a manifest over all of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from shortfinal.data.image import Image, read_image
from shortfinal.errors import InputError
from shortfinal.evaluate.card import model_card, with_card
from shortfinal.evaluate.faults import PAPER_M
from shortfinal.evaluate.pack import write_manifest
from shortfinal.evaluate.run import Evaluation, Subject, label_files
from shortfinal.evaluate.tables import write_tables
from shortfinal.files import make_folder, write_png, write_whole
from shortfinal.keypoints import GaussianKeypoints
from shortfinal.report.examples import ExamplePicture, as_jpeg, example_pictures, rejection_example
from shortfinal.report.page import write_page
from shortfinal.report.plots import write_plots

_TRIES = 20  # rows looked at for the example of a rejection


def write_report(
    evaluation: Evaluation,
    out: str | Path,
    subject: Subject,
    data: str | Path,
    requirements: str | Path | None = None,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> None:
    """Write report.html, evaluation.json, rows.parquet, metrics.parquet, figures/, model_card.md and manifest.json.

    Of a model also a copy that carries the card; the file itself stays as it is. The manifest comes last and
    lists the others. Raises InputError if something cannot be written.
    """
    folder, evidence, rows = make_folder(out), evaluation.evidence, evaluation.rows
    paths = [known.target.picture.path for known in evaluation.truth.known]

    def picture(row: int) -> Image | None:
        try:
            return read_image(paths[row])
        except InputError:
            return None  # among the problems already

    progress("writing", 0, 3)
    evidence["notes"] += write_tables(folder, rows, evidence["metrics"])
    write_whole(folder / "evaluation.json", json.dumps(evidence, indent=1, allow_nan=False) + "\n")
    card = model_card(evidence)
    write_whole(folder / "model_card.md", card)
    if subject.kind == "model":
        write_whole(folder / subject.path.name, with_card(subject.path.read_bytes(), card))
    plots = write_plots(folder, evidence, rows)
    progress("writing", 1, 3)
    examples = example_pictures(rows, picture)
    if (rejected := _rejected(evaluation, picture)) is not None:
        write_png(folder / "figures" / "rejection_example.png", rejected[1])
        title = f"{rows.picture[rejected[0]]}: accepted, and refused with a runway believed {PAPER_M:g} m longer"
        examples.append(ExamplePicture(rejected[0], title, as_jpeg(rejected[1])))
    write_page(folder, evidence, rows, plots, examples)
    progress("writing", 2, 3)
    write_manifest(
        folder, evidence, subject=subject.path, data=data, labels=label_files(evaluation.truth),
        pictures=sorted(set(paths)), requirements=requirements,
        seeds={"planted faults": evidence["settings"]["seed"]},
    )  # fmt: skip
    progress("writing", 3, 3)


def _rejected(evaluation: Evaluation, picture: Callable[[int], Image | None]) -> tuple[int, Image] | None:
    """The nearest row that shows the paper's fault: accepted as it is, and refused with it; and its picture."""
    rows = evaluation.rows
    caught = np.flatnonzero(rows.accepted & (rows.caught_184m == 1))
    for row in caught[np.argsort(rows.distance_m[caught], kind="stable")][:_TRIES]:
        known, image = evaluation.truth.known[row], picture(int(row))
        if image is not None and known.runway is not None and known.camera is not None:
            keypoints = GaussianKeypoints(rows.mean_px[row], rows.cov_px[row])
            rate = evaluation.evidence["settings"]["false_alarm_rate"]
            drawn = rejection_example(image, keypoints, known.runway, known.camera, false_alarm_rate=rate)
            if drawn is not None:
                return int(row), drawn
    return None
