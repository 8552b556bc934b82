"""Reading and writing files so that nothing is ever half written and nothing that is read can run code.

Arrays travel as safetensors with one JSON object in the header; there is no pickle.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from lodestone.errors import BadFile, CannotWrite

HEADER = "lodestone"
"""Key of our JSON object in a safetensors header."""


def prepare_folder(path: Path) -> Path:
    """Make `path` and its parents. Raises `CannotWrite` unless files can be written there."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise CannotWrite(f"The output folder {path} cannot be written: {error.strerror or error}.") from None
    return path


def write_atomically(path: Path, content: bytes) -> None:
    """The file appears whole or not at all. Raises `CannotWrite`."""
    write_file_atomically(path, lambda temporary: temporary.write_bytes(content))


def write_file_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Call `write(temporary path)`, then move what it wrote to `path`. Raises `CannotWrite`."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp{path.suffix}")
    try:
        write(temporary)
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise CannotWrite(f"{path} cannot be written: {error.strerror or error}.") from None
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, content: Any) -> None:
    """Indented JSON; numbers that JSON lacks (NaN, infinities) are refused."""
    write_atomically(path, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any:
    """Raises `BadFile`."""
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise BadFile(f"{path} cannot be read: {error.strerror or error}.") from None
    except ValueError:
        raise BadFile(f"{path} is no JSON file.") from None


def write_arrays(path: Path, arrays: dict[str, np.ndarray], header: dict[str, Any]) -> None:
    """Named arrays and one JSON object, as safetensors."""
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    write_atomically(path, save(contiguous, metadata={HEADER: json.dumps(header)}))


def read_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """What `write_arrays` wrote. Raises `BadFile` for a missing, truncated or foreign file."""
    try:
        with safe_open(path, framework="numpy") as file:
            header = (file.metadata() or {}).get(HEADER)
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except OSError as error:
        raise BadFile(f"{path} cannot be read: {error.strerror or error}.") from None
    except (SafetensorError, TypeError, ValueError, KeyError, AttributeError):
        raise BadFile(f"{path} is truncated, or no safetensors file.") from None
    if header is None:
        raise BadFile(f"{path} was not saved by Lodestone.")
    try:
        content = json.loads(header)
    except ValueError:
        content = None
    if not isinstance(content, dict):
        raise BadFile(f"{path} was not saved by Lodestone.")
    return arrays, content
