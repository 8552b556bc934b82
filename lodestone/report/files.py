"""Writing a file so that a reader sees the old one or the new one, never half of it."""

from __future__ import annotations

import os
from pathlib import Path

from lodestone.errors import CannotWrite


def replace_file(path: str | Path, content: bytes) -> None:
    """Write `content` beside `path`, then put it in its place. Missing folders are made.

    Raises `CannotWrite`.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            part.write_bytes(content)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise CannotWrite(f"Cannot write {path}: {error.strerror or error}.") from error
