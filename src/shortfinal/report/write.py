"""An evaluation as a folder: record, tables, pictures, page, model card, and a manifest over all of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from shortfinal.data.image import Image, read_image
from shortfinal.errors import InputError
from shortfinal.evaluate.card import model_card, with_card
from shortfinal.evaluate.pack import write_manifest
from shortfinal.evaluate.run import Evaluation, Subject, label_files
from shortfinal.evaluate.tables import write_tables
from shortfinal.files import make_folder, write_whole
from shortfinal.report.examples import example_pictures
from shortfinal.report.page import write_page
from shortfinal.report.plots import write_plots


def write_report(
    evaluation: Evaluation,
    out: str | Path,
    subject: Subject,
    data: str | Path,
    requirements: str | Path | None = None,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> None:
    """Write report.html, evaluation.json, rows.parquet, metrics.parquet, figures/, model_card.md and manifest.json.

    Of a model also a copy that carries the card; the file itself stays as it is. The manifest comes last and lists the others. Raises InputError if something cannot be written.
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
    write_page(folder, evidence, rows, plots, example_pictures(rows, evidence, picture))
    progress("writing", 2, 3)
    write_manifest(
        folder, evidence, subject=subject.path, data=data, labels=label_files(evaluation.truth),
        pictures=sorted(set(paths)), requirements=requirements,
        seeds={"planted faults": evidence["settings"]["seed"]},
    )  # fmt: skip
    progress("writing", 3, 3)
