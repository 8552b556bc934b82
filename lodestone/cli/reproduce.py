"""`lodestone reproduce`: the paper's two figures, or another experiment."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Literal

from rich.console import Console
from rich.table import Table

from lodestone.cli.parsing import check_seeds, parse
from lodestone.cli.printing import print_json
from lodestone.console import ConsoleProgress
from lodestone.errors import InvalidConfig, check_name
from lodestone.experiments import magnet_tower
from lodestone.experiments.comparison import Gate
from lodestone.experiments.registry import EXPERIMENTS, experiment
from lodestone.experiments.study import Study
from lodestone.files import prepare_folder

MAGNET_TOWER = "magnet-tower"
"""The experiment that `reproduce` runs unless told otherwise."""
TOWER_SEEDS = 6
"""Its seeds by default."""


@dataclass(frozen=True)
class Reproduce:
    """Reproduce the paper: pretrain the options, train DQN with options and DQN, and set both beside the optimum.

    Or run another experiment, by its name."""

    experiment: str = MAGNET_TOWER
    """The paper's towers of a magnet arm, or an experiment that --list names."""
    figure: Literal["2", "3", "all"] = "all"
    """Of magnet-tower. 2: a 4x3 grid with 3 bricks. 3: a 6x4 grid with 4 bricks."""
    seeds: int | None = None
    """Seeds per curve, trained at once. Default: 6 for magnet-tower, otherwise as --list says."""
    preset: Literal["fast", "paper"] = "fast"
    """Of magnet-tower. fast: our tuning of the same algorithms. paper: the authors' protocol."""
    out: Path | None = None
    """Folder for report.html, the figures, results.json and, of magnet-tower, the animation and what was learned.
    Default: out/reproduce for magnet-tower, otherwise out/ and the experiment's name."""
    list: bool = False
    """Print the experiments' names, titles and seeds, and run none."""
    json: bool = False
    """Print results.json on standard output, too."""


def run(words: list[str]) -> None:
    """Parse the words after `reproduce` and run the experiment."""
    _reproduce(parse(Reproduce, "reproduce", words))


def _reproduce(settings: Reproduce) -> None:
    if settings.list:
        _list_experiments(settings.json)
        return
    check_name("experiment", settings.experiment, (MAGNET_TOWER, *EXPERIMENTS))
    if settings.seeds is not None:
        check_seeds(settings.seeds)
    if settings.experiment == MAGNET_TOWER:
        _reproduce_towers(settings, settings.seeds or TOWER_SEEDS, settings.out or Path("out/reproduce"))
        return
    for flag, value, default in (("figure", settings.figure, "all"), ("preset", settings.preset, "fast")):
        if value != default:
            raise InvalidConfig(f"--{flag} belongs to {MAGNET_TOWER}; {settings.experiment} has no such choice.")
    _reproduce_study(settings)


def _list_experiments(as_json: bool) -> None:
    rows = [
        {"name": MAGNET_TOWER, "title": "Towers of a magnet arm: figures 2 and 3 of the paper", "seeds": TOWER_SEEDS},
        *({"name": one.name, "title": one.title, "seeds": one.seeds} for one in EXPERIMENTS.values()),
    ]
    if as_json:
        print_json(rows)
        return
    width = max(len(str(row["name"])) for row in rows)
    for row in rows:
        print(f"{row['name']:{width}}  {row['title']} ({row['seeds']} seeds)")


def _reproduce_towers(settings: Reproduce, seeds: int, out: Path) -> None:
    from lodestone.report.reproduction import Reproduction  # matplotlib is only needed here

    figures = magnet_tower.FIGURES if settings.figure == "all" else (settings.figure,)
    chosen = [magnet_tower.settings(figure, settings.preset) for figure in figures]
    reproduction = Reproduction(prepare_folder(out), settings.preset, seeds, settings.figure)
    try:
        with ConsoleProgress(magnet_tower.total_work(chosen, seeds)) as progress:
            for one in chosen:
                magnet_tower.run(one, range(seeds), progress, reproduction.save)
    except KeyboardInterrupt:
        finished = ", ".join(reproduction.finished) or "nothing yet"
        print(f"\nInterrupted. Finished and kept in {out}: {finished}.", file=sys.stderr)
        raise
    if settings.json:
        print_json(reproduction.results())
        return
    _print_gates(reproduction.gates())
    print(f"Wrote {out / 'report.html'} and, beside it: {', '.join(reproduction.files)}.")


def _reproduce_study(settings: Reproduce) -> None:
    from lodestone.report.reproduction import provenance  # matplotlib is only needed here
    from lodestone.report.studies import save_study, study_json

    chosen = experiment(settings.experiment)
    seeds, folder = settings.seeds or chosen.seeds, prepare_folder(settings.out or Path("out") / chosen.name)
    started = perf_counter()
    with ConsoleProgress(chosen.work) as progress:
        study = chosen.run(seeds, progress)
    told = provenance(f"lodestone reproduce --experiment {chosen.name} --seeds {seeds} --out {folder}")
    told |= {"seeds": seeds, "seconds": perf_counter() - started}
    written = save_study(folder, study, told)
    if settings.json:
        print_json(study_json(study, told))
        return
    _print_tables(study)
    _print_gates(study.gates)
    others = [name for name in written if name != "report.html"]
    print(f"Wrote {folder / 'report.html'} and, beside it: {', '.join(others)}.")


def _print_tables(study: Study) -> None:
    from lodestone.report.page import number_text

    for numbers in study.tables:
        table = Table(*numbers.columns, title=numbers.title, title_justify="left")
        for row in numbers.rows:
            table.add_row(*(value if isinstance(value, str) else number_text(value, 4) for value in row))
        Console().print(table)


def _print_gates(gates: Sequence[Gate]) -> None:
    table = Table("", "measured", "required", "", title="What must come out", title_justify="left")
    for gate in gates:
        table.add_row(gate.name, f"{gate.measured:.4g}", gate.required, "passed" if gate.passed else "MISSED")
    Console().print(table)
