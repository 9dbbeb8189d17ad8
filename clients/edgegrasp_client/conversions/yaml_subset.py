"""The little YAML that `isaac_grasp` files need, so that the client needs no YAML package.

Mappings nested by indentation, lists of scalars, `[...]` and `{...}` within a line, quotes and
comments. Numbers become floats, everything else is text.
"""

import json
import re
from collections.abc import Iterator
from typing import Any

_QUOTED = r""""(?:[^"\\]|\\.)*"|'[^']*'"""
_COMMENT = re.compile(rf"({_QUOTED})|(?:^|\s)#.*$")
_KEY = re.compile(rf"""( *)({_QUOTED}|[^\s\-:"'][^:"']*?) *:(?: +|$)""")
_TOKEN = re.compile(rf"""[\[\]{{}},]|{_QUOTED}|[^\s\[\]{{}},"'][^\[\]{{}},"']*""")


def read_mapping(text: str) -> dict[str, Any]:
    """Read a text whose outermost value is a mapping.

    Raises:
        ValueError: A line is none of what is read here; says which.
    """
    root: dict[str, Any] = {}
    mappings = [(-1, root)]  # indentation and mapping of the blocks around the line
    last_key = ""  # of the innermost mapping but one, if its block is empty so far
    for number, raw in enumerate(text.splitlines(), start=1):
        line = _COMMENT.sub(lambda match: match[1] or "", raw).rstrip()
        if not line or line == "---":
            continue
        key = _KEY.match(line)
        try:
            if key is None:
                _append(mappings, last_key, line)
                continue
            indent = len(key[1])
            while indent <= mappings[-1][0]:
                mappings.pop()
            last_key, rest = _scalar_text(key[2]), line[key.end() :]
            value: Any = _flow(rest) if rest else {}
            mappings[-1][1][last_key] = value
            if not rest:
                mappings.append((indent, value))
        except (AttributeError, IndexError, KeyError, StopIteration, ValueError):
            raise ValueError(f"line {number}: got {raw!r}. Give `name: value`.") from None
    return root


def _append(mappings: list[tuple[int, dict[str, Any]]], key: str, line: str) -> None:
    """Add a line `- value` to the list under the key before it."""
    dash, _, item = line.strip().partition(" ")
    if dash != "-":
        raise ValueError
    parent = mappings[-2][1]
    if parent[key] == {}:
        parent[key] = []
    parent[key].append(_flow(item))


def _flow(text: str) -> Any:
    """A value within a line."""
    tokens = iter(_TOKEN.findall(text))
    value = _value(next(tokens), tokens)
    if next(tokens, None) is not None:
        raise ValueError
    return value


def _value(token: str, tokens: Iterator[str]) -> Any:
    if token == "[":
        return [_value(part, tokens) for part in _parts(tokens, "]")]
    if token == "{":
        mapping = {}
        for part in _parts(tokens, "}"):
            name, colon, rest = part.partition(":")
            if not colon:
                raise ValueError
            mapping[name] = _value(rest.strip() or next(tokens), tokens)
        return mapping
    if token in ("]", "}", ","):
        raise ValueError
    return _scalar(token.strip())


def _parts(tokens: Iterator[str], end: str) -> Iterator[str]:
    """First tokens of the parts of a list or mapping, up to its end."""
    while (token := next(tokens, "")) != end:
        if not token:
            raise ValueError
        if token != ",":
            yield token


def _scalar(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return _scalar_text(text)


def _scalar_text(text: str) -> str:
    if text[0] == '"':
        return str(json.loads(text))
    return text[1:-1] if text[0] == "'" else text
