"""Turn a sound file into a hostile one: damaged bytes, strange text, JSON of wrong shapes.

`mutated` makes every choice with the generator that it is given, so a seed gives the same bytes.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

from numpy.random import Generator

NUMBERS = (
    "nan", "NaN", "inf", "-inf", "-1", "0", "-0.0", "1e308", "-1e308", "1e-320", "1e999", "9" * 400,
    "1" * 5000, "9223372036854775808", "-9223372036854775809", "18446744073709551616", "1_000",
    "0x10", "1,5", "٣", "1e", "", " ", "true", "null", "4294967296", "1.5", "3.0000000001",
)  # fmt: skip
NAMES = (
    "/abs/path", "../../x", "..", ".hidden", "a/b", "a\\b", "C:\\x", "a\nb", "a\r\nb", 'a"b', "a'b",
    "a\x00b", "a\x1b[2J", "\u202etfel", "\u2028", "\ufeff", "", " ", "x" * 300, "x" * 60_000,
    "<!--<script>", "</script><b>", "=cmd|' /C calc'!A0", "@SUM(1)", "Zähler 1", "名前", "con",
    "{0}", "$(x)", "`x`", "-rf", "~", "a:b", "a|b", "spy://x?file=y",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, "", "text", "9" * 400, 0, -1, 10**400, -(10**30), 2**63, 1e308, 1e-320,
    float("nan"), float("inf"), 1.5, [], {}, [[]], [None], [[1, 2], [3]], {"a": 1}, "\ud800",
    [1, "2", None], [[0.0] * 3] * 3, [0.0] * 3, "x" * 60_000, [0] * 20_000,
)  # fmt: skip
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(r"[^\W\d]\w+")


def mutated(content: bytes, kind: str, rng: Generator) -> bytes:
    """Return a hostile version of a file's bytes.

    kind : "csv", "toml", "json", "text" or "binary". Text also gets the mutations of bytes.
    """
    for _ in range(int(rng.integers(1, 4))):
        if kind == "binary" or rng.random() < 0.2:
            content = _pick(BYTES, rng)(content, rng)
        elif kind == "json" and rng.random() < 0.75:
            content = _json(content, rng)
        else:
            text = content.decode("utf-8", "surrogateescape")
            own = {"csv": CSV, "toml": TOML, "json": JSON}.get(kind, ())
            text = _pick((*TEXT, *own), rng)(text, rng)
            content = text.encode("utf-8", "surrogateescape")
    return content


def _pick(choices: Any, rng: Generator) -> Any:
    return choices[int(rng.integers(len(choices)))]


def _span(length: int, rng: Generator) -> tuple[int, int]:
    """A stretch of a file: its begin is anywhere or near the head, its length short or long."""
    reach = length if rng.random() < 0.6 else min(length, 256)
    begin = int(rng.integers(0, reach + 1))
    return begin, min(length, begin + int(2 ** rng.uniform(0, 10)))


# ------------------------------------------------------------------------------------- bytes


def _truncated(b: bytes, rng: Generator) -> bytes:
    return b[: _span(len(b), rng)[0]]


def _flipped(b: bytes, rng: Generator) -> bytes:
    out = bytearray(b)
    for _ in range(int(2 ** rng.uniform(0, 6)) if out else 0):
        begin, _ = _span(len(out) - 1, rng)
        out[begin] ^= 1 << int(rng.integers(8))
    return bytes(out)


def _spliced(b: bytes, rng: Generator) -> bytes:
    begin, end = _span(len(b), rng)
    place, _ = _span(len(b), rng)
    return b[:place] + b[begin:end] + b[place + end - begin :]


def _duplicated(b: bytes, rng: Generator) -> bytes:
    begin, end = _span(len(b), rng)
    return b[:end] + b[begin:end] * int(rng.integers(1, 20)) + b[end:]


def _removed(b: bytes, rng: Generator) -> bytes:
    begin, end = _span(len(b), rng)
    return b[:begin] + b[end:]


def _inserted(b: bytes, rng: Generator) -> bytes:
    begin, _ = _span(len(b), rng)
    extra = _pick((b"\0", b"\0" * 64, b"\xff" * 8, b"\xef\xbb\xbf", b"\xed\xa0\x80", b"\x1a"), rng)
    return b[:begin] + extra + b[begin:]


def _overwritten(b: bytes, rng: Generator) -> bytes:
    """A field of a binary header replaced by an extreme number."""
    begin, _ = _span(len(b), rng)
    width = int(_pick((1, 2, 4, 8), rng))
    number = int(_pick((0, 1, 2**31 - 1, 2**32 - 1, 2**31, 50_000, 2**63 - 1, 2**16 - 1), rng))
    field = (number % 2 ** (8 * width)).to_bytes(width, _pick(("little", "big"), rng))
    return b[:begin] + field + b[begin + width :]


def _random(b: bytes, rng: Generator) -> bytes:
    begin, end = _span(len(b), rng)
    return b[:begin] + rng.bytes(end - begin) + b[end:]


def _emptied(b: bytes, rng: Generator) -> bytes:
    return b"" if rng.random() < 0.3 else b[:16] + bytes(max(len(b) - 16, 0))


BYTES = (_truncated, _flipped, _flipped, _spliced, _duplicated, _removed, _inserted, _overwritten,
         _overwritten, _random, _emptied)  # fmt: skip


# -------------------------------------------------------------------------------------- text


def _lines(change: Callable[[list[str], int, Generator], None]) -> Callable[[str, Generator], str]:
    def changed(text: str, rng: Generator) -> str:
        lines = text.split("\n")
        change(lines, int(rng.integers(len(lines))), rng)
        return "\n".join(lines)

    return changed


def _delete_line(lines: list[str], i: int, rng: Generator) -> None:
    del lines[i : i + int(rng.integers(1, 4))]


def _repeat_line(lines: list[str], i: int, rng: Generator) -> None:
    lines[i:i] = [lines[i]] * int(_pick((1, 1, 2, 500), rng))


def _swap_lines(lines: list[str], i: int, rng: Generator) -> None:
    j = int(rng.integers(len(lines)))
    lines[i], lines[j] = lines[j], lines[i]


def _replace(pattern: re.Pattern[str], hostile: tuple[str, ...]) -> Callable[[str, Generator], str]:
    def replaced(text: str, rng: Generator) -> str:
        found = list(pattern.finditer(text))
        if not found:
            return text
        one = _pick(found, rng)
        return text[: one.start()] + _pick(hostile, rng) + text[one.end() :]

    return replaced


def _insert_text(text: str, rng: Generator) -> str:
    place = int(rng.integers(len(text) + 1))
    extra = _pick((*NAMES, *NUMBERS, '"', "'", "[", "]", "{", "=", "#"), rng)
    return text[:place] + extra + text[place:]


def _rename_everywhere(text: str, rng: Generator) -> str:
    found = _WORD.findall(text)
    return text.replace(_pick(found, rng), _pick(NAMES, rng)) if found else text


TEXT = (
    _lines(_delete_line), _lines(_repeat_line), _lines(_swap_lines), _replace(_NUMBER, NUMBERS),
    _replace(_NUMBER, NUMBERS), _replace(_WORD, NAMES), _insert_text, _rename_everywhere,
)  # fmt: skip


def _drop_column(text: str, rng: Generator) -> str:
    rows = [line.split(",") for line in text.split("\n")]
    i = int(rng.integers(len(rows[0])))
    return "\n".join(",".join(row[:i] + row[i + 1 :]) for row in rows)


def _repeat_column(text: str, rng: Generator) -> str:
    rows = [line.split(",") for line in text.split("\n")]
    i = int(rng.integers(len(rows[0])))
    return "\n".join(",".join([*row, row[i]]) if len(row) > i else line
                     for row, line in zip(rows, text.split("\n")))  # fmt: skip


def _set_column(text: str, rng: Generator) -> str:
    """One number in all rows of a column."""
    rows = [line.split(",") for line in text.split("\n")]
    i, number = int(rng.integers(len(rows[0]))), _pick(NUMBERS, rng)
    changed = [row[:i] + [number] + row[i + 1 :] if len(row) > i else row for row in rows[1:]]
    return "\n".join(",".join(row) for row in [rows[0], *changed])


def _many_columns(text: str, rng: Generator) -> str:
    """Tens of thousands of columns, rarely, because such a file takes long to make."""
    if rng.random() > 0.05:
        return text
    count = int(_pick((3_000, 100_000), rng))
    head, *rows = text.split("\n")[:3]
    more = ",".join(f"c{i}" for i in range(count))
    return "\n".join([f"{head},{more}", *(row + ",1" * count for row in rows)])


def _header_only(text: str, rng: Generator) -> str:
    return text.split("\n", 1)[0] + _pick(("", "\n", "\n\n\n"), rng)


CSV = (_drop_column, _repeat_column, _set_column, _set_column, _many_columns, _header_only)


def _nest(text: str, rng: Generator) -> str:
    depth = int(_pick((50, 3_000, 60_000), rng))
    return text + "\n" + _pick(
        (
            "x = " + "[" * depth + "]" * depth,
            ".".join(["a"] * depth) + " = 1",
            "[" + ".".join(["a"] * depth) + "]",
            "x = " + "{a = " * min(depth, 3_000) + "1" + "}" * min(depth, 3_000),
            "\n".join(f"k{i} = 1" for i in range(depth // 10)),
            "\n".join(f"[t{i}]\nk = 1" for i in range(depth // 20)),
            'x = "' + "y" * depth + '"',
        ),
        rng,
    )  # fmt: skip


TOML = (_nest,)


def _deep(text: str, rng: Generator) -> str:
    depth = int(_pick((50, 900, 100_000), rng))
    inner = _pick(("[" * depth + "]" * depth, '{"a":' * depth + "1" + "}" * depth), rng)
    place = text.rfind("}")
    return text[:place] + ', "deep": ' + inner + text[place:]


JSON = (_deep,)


# -------------------------------------------------------------------------------------- JSON


def _json(content: bytes, rng: Generator) -> bytes:
    """A value at a random place replaced, removed, repeated or renamed."""
    try:
        whole = [json.loads(content)]
    except (ValueError, RecursionError):
        return _pick(BYTES, rng)(content, rng)
    parent, key = _place(whole, rng)
    _pick((_set_value, _set_value, _drop_value, _reshape, _rename_key), rng)(parent, key, rng)
    text = json.dumps(whole[0] if whole else None)
    return text.encode("utf-8")


def _place(whole: Any, rng: Generator) -> tuple[Any, Any]:
    """A container and one of its keys; places near the root are as likely as those far from it."""
    parent, key = whole, 0
    while isinstance(parent[key], dict | list) and len(parent[key]) and rng.random() < 0.85:
        parent = parent[key]
        key = _pick(list(parent) if isinstance(parent, dict) else range(len(parent)), rng)
    return parent, key


def _set_value(parent: Any, key: Any, rng: Generator) -> None:
    named = isinstance(parent[key], str) and rng.random() < 0.6
    parent[key] = _pick(NAMES if named else VALUES, rng)


def _drop_value(parent: Any, key: Any, rng: Generator) -> None:
    del parent[key]


def _reshape(parent: Any, key: Any, rng: Generator) -> None:
    """A list cut, lengthened, wrapped or turned; anything else wrapped in a list."""
    value = parent[key]
    shapes = [[value], {"0": value}]
    if isinstance(value, list) and value:
        shapes += [value[:-1], value + value[-1:], value[::-1], value * 2, value[0]]
    parent[key] = _pick(shapes, rng)


def _rename_key(parent: Any, key: Any, rng: Generator) -> None:
    if isinstance(parent, dict):
        parent[_pick(NAMES, rng)] = parent.pop(key)
    else:
        parent.insert(key, _pick(VALUES, rng))
