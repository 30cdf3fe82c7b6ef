"""A settings file with every setting in it: its meaning, unit, limits and default; the JSON schema of it.

Written from the types alone. What is chosen stands there; every other setting stands behind a `#` with its
default, and counts when the `#` is taken away.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator
from typing import Any

import msgspec
import yaml
from msgspec import inspect as types

from vad.config.meaning import meaning, unit

WIDTH = 110
_COLUMN_MIN, _COLUMN_MAX = 26, 44
"""Where comments begin; what is longer has its comment above."""

EXAMPLE = "no default"
"""Said of a setting that is nothing by default: what stands there is an example."""

Line = tuple[str, str]
"""A line of YAML and the comment on it; a comment alone where the YAML is only its indentation."""


def settings_file(
    kind: type[msgspec.Struct], chosen: dict[str, Any], *, head: str = "", alternatives: bool = True
) -> str:
    """The text of a settings file.

    Args:
        kind: the class of the whole file.
        chosen: what is set, plain values as in YAML.
        head: comment lines at the top.
        alternatives: show the robots, cameras and CSI sources that were not chosen, too.
    """
    said = meaning(kind)
    info = types.type_info(kind)
    assert isinstance(info, types.StructType)
    blocks = [[*_comment_lines(head, 0)]] if head else []
    plain = [field for field in info.fields if not _is_section(field.type)]
    lines = [line for field in plain for line in _field(field, said.fields, chosen, 0)]
    blocks.append(_laid_out(lines))
    for field in info.fields:
        if _is_section(field.type):
            about = said.fields[field.encode_name]
            section = list(_section(field, "", chosen.get(field.encode_name, {}), 0, alternatives))
            blocks.append([*_comment_lines(about[0].upper() + about[1:], 0), *_laid_out(section)])
    return "\n\n".join("\n".join(block) for block in blocks if block) + "\n"


def settings_schema(kind: type[msgspec.Struct]) -> dict[str, Any]:
    """The JSON schema (2020-12), with what each setting means, for editors."""
    schema = msgspec.json.schema(kind)
    for found in _structs(types.type_info(kind)):
        said = meaning(found)
        part = schema["$defs"][found.__name__]
        part["description"] = said.summary
        for name, about in said.fields.items():
            told = unit(name)
            part["properties"][name]["description"] = f"{about} ({told})" if told else about
    for field in msgspec.structs.fields(kind):
        if field.default is not msgspec.NODEFAULT and isinstance(field.default, msgspec.Struct):
            part = schema["$defs"][kind.__name__]["properties"][field.name]
            if "$ref" in part:  # a section in which nothing stands
                part["anyOf"] = [{"$ref": part.pop("$ref")}, {"type": "null"}]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _structs(info: types.Type) -> Iterator[type[msgspec.Struct]]:
    """Every class of settings in a type, itself too."""
    info = _bare(info)
    if isinstance(info, types.StructType):
        yield info.cls
        for field in info.fields:
            yield from _structs(field.type)
    elif isinstance(info, types.UnionType):
        for part in info.types:
            yield from _structs(part)
    elif isinstance(info, types.VarTupleType):
        yield from _structs(info.item_type)


def _bare(info: types.Type) -> types.Type:
    """Without what a schema says beside it, and without None."""
    while True:
        if isinstance(info, types.Metadata):
            info = info.type
        elif isinstance(info, types.UnionType) and len(_choices(info)) == 1:
            info = _choices(info)[0]
        else:
            return info


def _choices(info: types.UnionType) -> list[types.Type]:
    return [part for part in info.types if not isinstance(part, types.NoneType)]


def _kinds(info: types.Type) -> list[types.StructType]:
    """The classes of which one is to be chosen; one where there is no choice, none for a plain value."""
    info = _bare(info)
    parts = _choices(info) if isinstance(info, types.UnionType) else [info]
    return [part for part in map(_bare, parts) if isinstance(part, types.StructType)]


def _is_section(info: types.Type) -> bool:
    return bool(_kinds(info))


def _section(
    field: types.Field, about: str, chosen: dict[str, Any], indent: int, alternatives: bool
) -> Iterator[Line]:
    """A section and all in it; where there is a choice, what is chosen first."""
    yield " " * indent + f"{field.encode_name}:", about
    kinds = _kinds(field.type)
    default = field.default if isinstance(field.default, msgspec.Struct) else None
    tag = chosen.get("type", default.__struct_config__.tag if default is not None else kinds[0].tag)
    kinds.sort(key=lambda kind: kind.tag != tag)
    tagged = len(kinds) > 1
    for kind in kinds if alternatives else kinds[:1]:
        active = kind is kinds[0]
        said = meaning(kind.cls)
        mark = "" if active else "#"
        if tagged:
            if not active:
                yield " " * (indent + 2), f"-- or: {said.summary.rstrip('.')}"
            yield " " * (indent + 2) + f"{mark}type: {kind.tag}", said.summary.rstrip(".") if active else ""
        for inner in kind.fields:
            if _is_section(inner.type):
                told, given = said.fields[inner.encode_name], chosen.get(inner.encode_name, {})
                yield from _section(inner, told, given, indent + 2, alternatives)
            else:
                yield from _field(inner, said.fields, chosen if active else {}, indent + 2, mark=mark)


def _field(
    field: types.Field, said: dict[str, str], chosen: dict[str, Any], indent: int, mark: str = ""
) -> Iterator[Line]:
    """A setting, behind a # where it is not chosen."""
    name = field.encode_name
    notes = [unit(name), *_limits(_bare(field.type))]
    before = " " * indent + (mark or ("" if name in chosen or field.required else "#"))
    item = _item(field.type)
    if name in chosen:
        value = chosen[name]
        if not field.required and field.default and msgspec.to_builtins(field.default) != value:
            notes.append(f"default {_yaml(field.default)}")
    elif field.required or not field.default:
        value, note = _example(field)
        notes.append(note)
    else:
        value = field.default
    about = said[name] + (f" ({', '.join(note for note in notes if note)})" if any(notes) else "")
    if item is None or name in chosen:
        yield before + f"{name}: {_yaml(value)}", about
        return
    yield before + f"{name}:", about
    inner = meaning(item.cls)
    for index, part in enumerate(item.fields):
        lead = "  - " if index == 0 else "    "
        example, _ = _example(part)
        yield before + f"{lead}{part.encode_name}: {_yaml(example)}", inner.fields[part.encode_name]


def _item(info: types.Type) -> types.StructType | None:
    """The class of a list's items, where it is a list of those."""
    info = _bare(info)
    if not isinstance(info, types.VarTupleType):
        return None
    item = _bare(info.item_type)
    return item if isinstance(item, types.StructType) else None


def _example(field: types.Field) -> tuple[Any, str]:
    """A value to show where the default is nothing, and what to say of it."""
    examples = _examples(field.type)
    if field.required:
        return examples[0] if examples else "", ""
    if not examples or isinstance(field.default, bool | int | float):
        return field.default, ""
    return examples[0], EXAMPLE


def _examples(info: types.Type) -> list[Any]:
    if isinstance(info, types.Metadata):
        found = (info.extra_json_schema or {}).get("examples")
        return list(found) if found else _examples(info.type)
    if isinstance(info, types.UnionType):
        return [example for part in info.types for example in _examples(part)]
    if isinstance(info, types.VarTupleType):
        return [[example] for example in _examples(info.item_type)[:1]]
    return []


def _limits(info: types.Type) -> list[str]:
    """What a value may be, in words."""
    if isinstance(info, types.LiteralType):
        *first, last = map(str, info.values)
        return [f"{', '.join(first)} or {last}" if first else last]
    if not isinstance(info, types.IntType | types.FloatType):
        return []
    low = f"> {info.gt:g}" if info.gt is not None else f">= {info.ge:g}" if info.ge is not None else ""
    high = f"< {info.lt:g}" if info.lt is not None else f"<= {info.le:g}" if info.le is not None else ""
    if info.ge is not None and info.le is not None:
        return [f"{info.ge:g} to {info.le:g}"]
    return [f"{low} {high}".strip()] if low or high else []


def _yaml(value: Any) -> str:
    """A value on one line of YAML."""
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_yaml, value))}]"
    if isinstance(value, str) and ":" in value:
        return json.dumps(value, ensure_ascii=False)  # 11:22:33 without quotes is a number to YAML 1.1
    text: str = yaml.safe_dump(
        msgspec.to_builtins(value), default_flow_style=True, allow_unicode=True, width=10_000, sort_keys=False
    )
    return text.removesuffix("...\n").strip()


def _number(value: float) -> str:
    """A number as people write it; YAML 1.1 wants a point and a sign in 5.24e+9."""
    if abs(value) < 1e6:
        return f"{value:g}" if float(f"{value:g}") == value else repr(value)
    digits, _, power = f"{value:e}".partition("e")
    short = f"{float(digits):g}"
    text = f"{short if '.' in short else short + '.0'}e{int(power):+d}"
    return text if float(text) == value else repr(value)


def _laid_out(lines: list[Line]) -> list[str]:
    """YAML on the left, comments in one column; a long line has its comment above."""
    widths = [len(text) for text, _ in lines if len(text) <= _COLUMN_MAX]
    column = max(_COLUMN_MIN, *widths, 0) + 2
    result = []
    for text, comment in lines:
        indent = len(text) - len(text.lstrip())
        if not comment:
            result.append(text)
        elif not text.strip():
            result += _comment_lines(comment, indent)
        elif len(text) + 2 > column:
            result += [*_comment_lines(comment, indent), text]
        else:
            first, *more = textwrap.wrap(comment, WIDTH - column - 2)
            result.append(f"{text:<{column}}# {first}")
            result += [f"{'':<{column}}# {line}" for line in more]
    return result


def _comment_lines(text: str, indent: int) -> list[str]:
    lines = [line for part in text.splitlines() for line in textwrap.wrap(part, WIDTH - indent - 2)]
    return [" " * indent + f"# {line}" for line in lines]
