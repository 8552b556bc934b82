"""The command line."""

from lodestone.cli.program import main

__all__ = ["main"]
