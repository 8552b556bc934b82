"""Reading and writing files so that nothing is ever half written and nothing that is read can run code.

Arrays travel as safetensors with one JSON object in the header; there is no pickle.
"""

from __future__ import annotations

import json
import math
import os
import stat
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

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


def lock(path: Path) -> BinaryIO:
    """Hold `path`, an empty file, until what is returned is closed or this process ends, however it ends.

    Raises `CannotWrite` while another process holds it. Where files cannot be locked (Windows, some network file
    systems) it holds nothing.
    """
    try:
        file = path.open("ab+")  # to read, too: else a pipe of this name would keep the program waiting
    except OSError as error:
        raise CannotWrite(f"The output folder {path.parent} cannot be written: {error.strerror or error}.") from None
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        raise CannotWrite(f"Another process is writing in {path.parent}.") from None
    except (ImportError, OSError):
        pass
    return file


def write_atomically(path: str | Path, content: bytes) -> None:
    """The file appears whole or not at all; missing folders are made. Raises `CannotWrite`."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise CannotWrite(f"Cannot write {path}: {error.strerror or error}.") from None


def json_safe(value: object) -> Any:
    """The same in JSON's types: data classes and named tuples as objects, arrays as lists, not-finite numbers as None,
    anything else as its text."""
    match value:
        case None | bool() | int() | str():
            return value
        case np.generic() | np.ndarray():
            return json_safe(value.tolist())
        case float():
            return value if math.isfinite(value) else None
        case Mapping():
            return {str(key): json_safe(each) for key, each in value.items()}
        case tuple() if hasattr(value, "_asdict"):
            return json_safe(value._asdict())
        case list() | tuple():
            return [json_safe(each) for each in value]
        case _ if hasattr(value, "__dataclass_fields__"):
            return {name: json_safe(getattr(value, name)) for name in value.__dataclass_fields__}
        case _:
            return str(value)


def write_json(path: str | Path, content: object) -> None:
    """Indented JSON of `json_safe(content)`. Raises `CannotWrite`."""
    text = json.dumps(json_safe(content), indent=2, ensure_ascii=False, allow_nan=False)
    write_atomically(path, f"{text}\n".encode(errors="backslashreplace"))


def read_file(path: Path) -> bytes:
    """Raises `BadFile`."""
    _refuse_devices(path)
    try:
        return path.read_bytes()
    except OSError as error:
        raise BadFile(f"{path} cannot be read: {error.strerror or error}.") from None


def _refuse_devices(path: Path) -> None:
    """Raise `BadFile` for a pipe or a device: reading could go on for ever."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return  # which the attempt to read it will say better
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise BadFile(f"{path} cannot be read: it is no file.")


def read_json(path: Path) -> Any:
    """Raises `BadFile`."""
    content = read_file(path)
    try:
        return json.loads(content)
    except (ValueError, RecursionError):
        raise BadFile(f"{path} is no JSON file.") from None


def write_arrays(path: Path, arrays: dict[str, np.ndarray], header: dict[str, Any]) -> None:
    """Named arrays and one JSON object, as safetensors."""
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    write_atomically(path, save(contiguous, metadata={HEADER: json.dumps(header)}))


def read_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """What `write_arrays` wrote. Raises `BadFile` for a missing, truncated or foreign file."""
    _refuse_devices(path)
    try:
        path.open("rb").close()  # safetensors says of a file that may not be read that there is none
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
    except (ValueError, RecursionError):
        content = None
    if not isinstance(content, dict):
        raise BadFile(f"{path} was not saved by Lodestone.")
    return arrays, content
