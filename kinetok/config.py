"""Frozen dataclasses to JSON and back, strictly.

    @dataclass(frozen=True, kw_only=True)
    class PPOConfig:
        epochs: int = 4
        clip: float = 0.2

    config = from_dict(PPOConfig, json.loads(text))
    config = override(config, ["epochs=6"])
    json.dumps(to_dict(config))

Fields may be bool, int, float, str, Literal, tuples, dict[str, ...], nested configs, and unions of these. A
union of several configs is told apart by their `kind` fields: `kind: Literal["fsq"] = "fsq"`.

Refuses, with a ConfigError that names the key, the value and what is allowed: unknown keys, missing keys,
wrong types (an int stands for a float; a bool stands for neither). Knows no file, no command line and no
other room.
"""

import ast
import dataclasses
import difflib
import json
import math
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

T = TypeVar("T")
MISSING = dataclasses.MISSING


class ConfigError(ValueError):
    """A configuration that cannot be built; the message names the key, the value and the remedy."""


def nearest(name: object, choices: Iterable[str]) -> str:
    """A phrase to end an error with: "; did you mean 'epochs'?", or "" where nothing is close."""
    by_lower = {choice.lower(): choice for choice in choices}
    close = difflib.get_close_matches(str(name).lower(), list(by_lower), n=1)
    return f"; did you mean {by_lower[close[0]]!r}?" if close else ""


def pick(table: Mapping[str, T], name: str, what: str) -> T:
    """table[name]; an unknown name raises a ConfigError listing the keys and the nearest of them."""
    if name not in table:
        raise ConfigError(f"unknown {what} {name!r}; one of: {_listed(table)}{nearest(name, table)}")
    return table[name]


def to_dict(config: Any) -> dict[str, Any]:
    """A dataclass as JSON-able dicts, lists and scalars (tuples become lists)."""
    if not _is_config(config):
        raise ConfigError(f"expected a dataclass instance, not {_said(config)}")
    return _encode(config, "config")


def from_dict(cls: type[T], data: Mapping[str, Any], where: str = "config") -> T:
    """An instance of the dataclass `cls` from what `to_dict` wrote. `where` names the root in messages."""
    fields = {field.name: field for field in dataclasses.fields(cls) if field.init}  # type: ignore[arg-type]
    if not isinstance(data, Mapping):
        raise ConfigError(f"{where}: expected an object with the keys of {cls.__name__}, not {_said(data)}")
    for key in data:
        if key not in fields:
            allowed = f"the keys of {cls.__name__} are: {_listed(fields)}"
            raise ConfigError(f"{where}: unknown key {key!r}; {allowed}{nearest(key, fields)}")
    for key, field in fields.items():
        if key not in data and field.default is MISSING and field.default_factory is MISSING:
            raise ConfigError(f"{where}: missing key {key!r}, which has no default in {cls.__name__}")
    hints = typing.get_type_hints(cls)
    values = {key: _decode(value, hints[key], f"{where}.{key}") for key, value in data.items()}
    try:
        return cls(**values)
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from error


def override(config: T, assignments: Iterable[str]) -> T:
    """A new config with assignments such as "ppo.epochs=6" or "future=1,2,5"; checked once, when all are made.

    The text is read by the field's type, and of two values for one key the later counts. Assigning another `kind`
    to a config in a union starts from the defaults of that kind, wherever it stands among the assignments.
    """
    data, pairs = to_dict(config), [_pair(assignment) for assignment in assignments]
    for keys, text in sorted(pairs, key=lambda pair: len(pair[0]) if pair[0][-1] == "kind" else math.inf):
        data = _assign(data, type(config), keys, text, "config")
    return from_dict(type(config), data)


def at_least(config: Any, least: float, remedies: Mapping[str, str]) -> None:
    """Raise ConfigError for the first key of `remedies` whose value in a config is below `least` or not a number."""
    for key, remedy in remedies.items():
        value = getattr(config, key)
        if not value >= least:
            raise ConfigError(f"{key} must be at least {least}, not {value}; {remedy}")


def below(config: Any, limit: float, remedies: Mapping[str, str]) -> None:
    """The same for a value that is not below `limit`."""
    for key, remedy in remedies.items():
        value = getattr(config, key)
        if not value < limit:
            raise ConfigError(f"{key} must be below {limit}, not {value}; {remedy}")


def diff(a: Any, b: Any) -> list[str]:
    """Lines "key: old -> new" for every leaf in which two configs (or their dicts) differ."""
    old, new = (_leaves(side if isinstance(side, Mapping) else to_dict(side), "") for side in (a, b))
    return [
        f"{key}: {old.get(key, '(absent)')} -> {new.get(key, '(absent)')}"
        for key in old | new
        if old.get(key) != new.get(key)
    ]


def _is_config(value: object) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "(none)"


def _said(value: object) -> str:
    return f"{value!r} ({type(value).__name__})"


def _encode(value: Any, where: str) -> Any:
    if value is None or type(value) in (bool, int, float, str):
        return value
    if _is_config(value):
        return {f.name: _encode(getattr(value, f.name), f"{where}.{f.name}") for f in dataclasses.fields(value)}
    if isinstance(value, (tuple, list)):
        return [_encode(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {key: _encode(item, f"{where}.{key}") for key, item in value.items()}
    raise ConfigError(f"{where}: {_said(value)} has no JSON form; use bool, int, float, str, tuple or a dataclass")


def _decode(value: Any, hint: Any, where: str) -> Any:
    """The value that JSON `value` means for a field annotated `hint`."""
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return _decode_union(value, get_args(hint), where)
    if origin is Literal:
        return _decode_literal(value, get_args(hint), where)
    if origin is tuple:
        return _decode_tuple(value, hint, where)
    if origin is dict:
        if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
            raise _wrong(value, hint, where)
        return {key: _decode(item, get_args(hint)[1], f"{where}.{key}") for key, item in value.items()}
    if dataclasses.is_dataclass(hint):
        return from_dict(hint, value, where)  # type: ignore[arg-type]
    if hint is float and type(value) is int:
        return float(value)
    if hint in (bool, int, float, str, types.NoneType):
        if type(value) is hint:
            return value
        raise _wrong(value, hint, where)
    raise ConfigError(f"{where}: the annotation {hint} is not one that a config may have")


def _decode_literal(value: Any, options: tuple[Any, ...], where: str) -> Any:
    for option in options:
        if type(value) is type(option) and value == option:
            return option
    close = nearest(value, [option for option in options if isinstance(option, str)])
    raise ConfigError(f"{where}: {value!r} is not one of: {_listed(map(repr, options))}{close}")


def _decode_tuple(value: Any, hint: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        raise _wrong(value, hint, where)
    items = get_args(hint)
    if len(items) == 2 and items[1] is Ellipsis:
        items = (items[0],) * len(value)
    if len(items) != len(value):
        raise ConfigError(f"{where}: expected {len(items)} values, not {len(value)}: {value!r}")
    return tuple(_decode(item, kind, f"{where}[{i}]") for i, (item, kind) in enumerate(zip(value, items, strict=True)))


def _decode_union(value: Any, members: tuple[Any, ...], where: str) -> Any:
    # An exact type wins, so that 3 stays an int where the field is float | int.
    if type(value) in members:
        return value
    members = tuple(member for member in members if member is not types.NoneType)
    if len(members) == 1:
        return _decode(value, members[0], where)
    configs = [member for member in members if dataclasses.is_dataclass(member)]
    if isinstance(value, Mapping) and configs:
        return from_dict(_member(value, configs, where), value, where)
    for member in members:
        try:
            return _decode(value, member, where)
        except ConfigError:
            continue
    raise _wrong(value, Union[members], where)  # noqa: UP007


def _member(value: Mapping[str, Any], configs: list[Any], where: str) -> Any:
    """The config class of a union that `value` was written from: the only one, or the one of its `kind`."""
    if len(configs) == 1:
        return configs[0]
    kinds = _kinds(configs)
    if value.get("kind") not in kinds:
        found = f"{value['kind']!r} is not one of" if "kind" in value else "missing key 'kind', one of"
        raise ConfigError(f"{where}: {found}: {_listed(kinds)}{nearest(value.get('kind', ''), kinds)}")
    return kinds[value["kind"]]


def _kinds(configs: Iterable[Any]) -> dict[str, Any]:
    kinds = {}
    for cls in configs:
        kind = next((field.default for field in dataclasses.fields(cls) if field.name == "kind"), None)
        if not isinstance(kind, str):
            raise ConfigError(f"{cls.__name__} stands in a union of configs; give it kind: Literal[...] = ...")
        kinds[kind] = cls
    return kinds


def _wrong(value: Any, hint: Any, where: str) -> ConfigError:
    names = [
        "null" if member is types.NoneType else str(member) if get_args(member) else member.__name__
        for member in _members(hint)
    ]
    return ConfigError(f"{where}: expected {' | '.join(names)}, not {_said(value)}")


def _pair(assignment: str) -> tuple[list[str], str]:
    """The keys and the text of "ppo.epochs=6"."""
    key, equals, text = assignment.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"cannot read {assignment!r}; write key=value, for example ppo.epochs=6")
    return key.strip().split("."), text.strip()


def _assign(data: Any, hint: Any, keys: list[str], text: str, where: str) -> Any:
    """A copy of the JSON `data` of a value annotated `hint`, with the leaf at `keys` read from `text`."""
    key, *rest = keys
    if not isinstance(data, dict):
        raise ConfigError(f"{where} is {data!r}, which has no key {key!r}")
    configs = [member for member in _members(hint) if dataclasses.is_dataclass(member)]
    hints = _hints(data, hint, configs, where)
    if key not in hints:
        raise ConfigError(f"{where}: unknown key {key!r}; one of: {_listed(hints)}{nearest(key, hints)}")
    if rest:
        return data | {key: _assign(data[key], hints[key], rest, text, f"{where}.{key}")}
    if key == "kind" and len(configs) > 1:
        chosen = _member({"kind": text}, configs, where)
        return data if data[key] == text else to_dict(from_dict(chosen, {}, where))
    value = _parse(text, hints[key])
    inner = [member for member in _members(hints[key]) if dataclasses.is_dataclass(member)]
    if inner and isinstance(data[key], dict) and value is not None:
        inside = _listed(f"{key}.{name}" for name in data[key])
        raise ConfigError(
            f"{where}.{key} is a {_member(data[key], inner, where).__name__}; assign one of its keys: {inside}"
        )
    return data | {key: value}


def _hints(data: dict[str, Any], hint: Any, configs: list[Any], where: str) -> dict[str, Any]:
    """How each key of the JSON of a config, or of a dict annotated `hint`, is annotated."""
    if not configs:
        item = next(get_args(member)[1] for member in _members(hint) if get_origin(member) is dict)
        return dict.fromkeys(data, item)
    cls = _member(data, configs, where)
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls) if field.init}


def _members(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)


def _parse(text: str, hint: Any) -> Any:
    """The JSON value that typed-in `text` means for `hint`; text that means nothing is returned as it is."""
    text = text.strip()
    members = _members(hint)
    if types.NoneType in members and text.lower() in ("none", "null"):
        return None
    for member in members:
        if get_origin(member) is Literal:
            for option in get_args(member):
                if text == str(option):
                    return option
        if get_origin(member) is tuple:
            return _parse_tuple(text, member)
        if get_origin(member) is dict:
            return _literal(text)
    if bool in members and text.lower() in ("true", "false"):
        return text.lower() == "true"
    for number in (int, float):
        if number in members:
            try:
                return number(text)
            except ValueError:
                continue
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] and text[0] in "\"'" else text


def _parse_tuple(text: str, hint: Any) -> Any:
    value = _literal(text)
    if isinstance(value, (tuple, list)):
        return list(value)
    inner = text[1:-1] if text[:1] + text[-1:] in ("()", "[]") else text
    items = get_args(hint) or (str,)
    parts = [part for part in inner.split(",") if part.strip()]
    return [
        _parse(part, items[i] if i < len(items) and items[-1] is not Ellipsis else items[0])
        for i, part in enumerate(parts)
    ]


def _literal(text: str) -> Any:
    for read in (json.loads, ast.literal_eval):
        try:
            return read(text)
        except (ValueError, SyntaxError):
            continue
    return text


def _leaves(data: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    leaves: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping) and value:
            leaves |= _leaves(value, f"{prefix}{key}.")
        else:
            leaves[f"{prefix}{key}"] = list(value) if isinstance(value, tuple) else value
    return leaves
