"""To standard output: what every command's printing shares."""

from __future__ import annotations

import json
from typing import Any

from lodestone.files import json_safe


def print_json(content: Any) -> None:
    """One JSON object; infinities and NaN, which JSON lacks, become null."""
    print(json.dumps(json_safe(content), indent=2, allow_nan=False))
