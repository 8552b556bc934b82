"""`lodestone report RUN...`: training runs as one page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from lodestone.cli.parsing import parse
from lodestone.cli.printing import print_json
from lodestone.errors import InvalidConfig
from lodestone.files import prepare_folder


@dataclass(frozen=True)
class Report:
    """Write a page about training runs, finished or not: learning curves beside the optimum, comparisons over seeds,
    which options were used, and an episode of each to click through. Runs that differ only in their seeds are one
    learner."""

    runs: Positional[tuple[Path, ...]]
    """Folders of `lodestone train --out`."""
    out: Path = Path("out/report")
    """Folder for report.html, runs.png and results.json."""
    json: bool = False
    """Print the numbers as one JSON object, too."""


def run(words: list[str]) -> None:
    """Parse the words after `report` and write."""
    _report(parse(Report, "report", words))


def _report(settings: Report) -> None:
    from lodestone.report import runs, studies  # pictures are only needed here, in `watch` and in `reproduce`

    if not settings.runs:
        raise InvalidConfig("`lodestone report` needs the folder of at least one run.")
    study = runs.study_of(runs.read_learners(settings.runs))
    folder = prepare_folder(settings.out)
    about = {"command": "lodestone report " + " ".join(map(str, settings.runs))}
    files = studies.save_study(folder, study, about)
    if settings.json:
        print_json({**studies.study_json(study, about), "out": str(folder), "files": files})
    else:
        print(f"Wrote {', '.join(files)} in {folder}.")
