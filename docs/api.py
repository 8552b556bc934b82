"""`python docs/api.py FOLDER`: the docstrings of every module as pages; a warning is an error."""

from __future__ import annotations

import sys
import warnings
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from typing import get_type_hints

import pdoc

import lodestone


def prepare_fields(module: str) -> None:
    """Give the constructors of a module's named tuples types instead of names of types: pdoc looks names up where a
    function was made, and Python makes these in no module, so it finds none.

    What Python says of all fields alike ("Alias for field number 0") is dropped.
    """
    for kind in vars(import_module(module)).values():
        if isinstance(kind, type) and kind.__module__ == module and hasattr(kind, "_fields"):
            kind.__new__.__annotations__ = get_type_hints(kind, include_extras=True)
            for one in (kind.__new__, *(vars(kind)[field] for field in kind._fields)):
                one.__doc__ = ""


def main(folder: Path) -> int:
    """Build; returns the exit code."""
    for found in walk_packages(lodestone.__path__, "lodestone."):
        if not found.name.endswith(".__main__"):
            prepare_fields(found.name)
    pdoc.render.configure(docformat="markdown", show_source=False, footer_text=f"Lodestone {lodestone.__version__}")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        pdoc.pdoc("lodestone", output_directory=folder)
    for one in told:
        print(one.message, file=sys.stderr)
    return 1 if told else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
