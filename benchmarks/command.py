"""What the tabular benchmarks share on the command line."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable

import jax

from lodestone.devices import use_all_cores


def run(description: str, title: str, measure: Callable[[int], dict[str, dict[str, float]]], seeds: int = 512) -> None:
    """Measure with the number of seeds that was asked for, or else `seeds`, on all cores; print a table or JSON."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=seeds, help=f"seeds trained at once (default: {seeds})")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    jax.config.update("jax_platforms", "cpu")
    use_all_cores()

    found = measure(arguments.seeds)
    if arguments.json:
        print(json.dumps({"cores": jax.device_count(), "seeds": arguments.seeds, **found}, indent=2))
        return
    print(f"{title}, {arguments.seeds} seeds at once, {jax.device_count()} cores")
    for name, rows in found.items():
        print(name)
        for row, value in rows.items():
            print(f"    {row:40}{value:>16,.0f}")
