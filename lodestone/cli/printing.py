"""What every command's printing shares."""

from __future__ import annotations

import json
import sys
from typing import Any

from lodestone.files import json_safe


def print_json(content: Any) -> None:
    """One JSON object on standard output; infinities and NaN, which JSON lacks, become null."""
    print(json.dumps(json_safe(content), indent=2, allow_nan=False))


def note(sentence: str) -> None:
    """Say something on standard error that does not stop the work."""
    print(f"lodestone: note: {sentence}", file=sys.stderr)
