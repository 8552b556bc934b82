"""Settings out of JSON: data classes of plain values, with every field checked; and numbers that fit compiled code."""

from __future__ import annotations

import math
import sys
from dataclasses import fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from lodestone.errors import InvalidConfig, check_name

LARGEST, LARGEST_FLOAT = 2**31 - 1, 3.4e38
"""The largest numbers of compiled code: an int32, and (nearly) a float32."""


def check_numbers(settings: Any, name: str) -> None:
    """Raise `InvalidConfig` for a number that compiled code cannot hold, anywhere in settings or in JSON.

    Infinities and NaN are left to those who know what a setting is for."""
    match settings:
        case bool():
            return
        case int() | float():
            largest = LARGEST if isinstance(settings, int) else LARGEST_FLOAT
            if largest < abs(settings) < math.inf:
                raise InvalidConfig(f"{name} is {settings!s:.60}, but may be at most {largest}.")
        case dict():
            for key, value in settings.items():
                check_numbers(value, key)
        case list() | tuple():
            for value in settings:
                check_numbers(value, name)
        case _ if is_dataclass(settings):
            for field in fields(settings):
                check_numbers(getattr(settings, field.name), field.name)


def from_json(kind: Any, value: Any, name: str) -> Any:
    """What `files.json_safe` wrote of the setting `name`: a bool, int, finite float or str, one of a Literal, one of
    these or None, a tuple, or a data class.

    Raises `InvalidConfig` for anything else, and `UnknownName` for a field that there is not.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if is_dataclass(kind) and isinstance(value, dict):
        types = get_type_hints(kind)
        known = tuple(field.name for field in fields(kind) if field.init)
        for one in value:
            check_name(f"setting of {name}", one, known)
        for one in known:
            if one not in value:
                raise InvalidConfig(f"The setting {one} of {name} is missing.")
        return kind(**{one: from_json(types[one], value[one], one) for one in known})  # type: ignore[operator]
    if origin in (Union, UnionType):
        (plain,) = (one for one in inner if one is not NoneType)
        return None if value is None else from_json(plain, value, name)
    if origin is tuple and isinstance(value, list) and (inner[-1] is Ellipsis or len(inner) == len(value)):
        kinds = inner[:1] * len(value) if inner[-1] is Ellipsis else inner
        return tuple(from_json(one, each, name) for one, each in zip(kinds, value, strict=True))
    if kind is float and type(value) in (int, float) and abs(value) <= sys.float_info.max:
        return float(value)
    if kind in (bool, int, str) and type(value) is kind:
        return value
    if origin is Literal and value in inner:
        return value
    raise InvalidConfig(f"{name} cannot be {value!r:.60}.")
