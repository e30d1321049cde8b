"""Strategies of hypothesis: damaged bytes of a file, and the file with other contents."""

import json
import re
import struct
import tomllib
from collections.abc import Callable, Iterator
from copy import deepcopy
from typing import Any

from hypothesis import strategies as st

FLOATS = (float("nan"), float("inf"), -1.0, 0.0, 1e-300)
NUMBERS = [struct.pack(form, n) for form in ("<I", ">I", "<Q") for n in (0, 1, 255, 2**32 - 1)]
NUMBERS += [struct.pack(form, n) for form in ("<f", "<d") for n in FLOATS]
WORDS = [b"NaN", b"1e999", b"-1", b"0", b"1" * 30, b"1" * 5000, b"null", b"[]", b"{}", b'"\\ud800"']
WORDS += [b"", b"\0", b"\n", b"inf", b"list uchar int", b"vertex", b"face", b"[" * 5_000]
VALUES = st.one_of(
    st.sampled_from(
        [None, True, [], {}, "", "\ud800", "\n", "<b>", "../x", "a" * 5000, 10**400, 2**64, *FLOATS]
    ),
    st.integers(-(2**33), 2**33),
    st.floats(),
    st.text(max_size=5),
    st.lists(st.floats(width=32), max_size=5),
    st.sampled_from([500, 5_000]).map("DEEP{}".format),
)


@st.composite
def damages(draw: st.DrawFn, data: bytes) -> bytes:
    """Bytes of a file: truncated, with bytes flipped, with numbers or words in the place of others,
    with a part repeated."""
    found = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, max(len(found) - 1, 0)))
        kind = draw(st.sampled_from(["cut", "flip", "number", "word", "token", "repeat"]))
        if kind == "cut":
            del found[place:]
        elif kind == "flip" and found:
            found[place] ^= 1 << draw(st.integers(0, 7))
        elif kind == "number":
            number = draw(st.sampled_from(NUMBERS))
            found[place : place + len(number)] = number
        elif kind == "word":
            found[place : place + draw(st.integers(0, 6))] = draw(st.sampled_from(WORDS))
        elif kind == "token":
            after = re.compile(rb"[^\s,:=]+").search(found, place)
            if after:
                found[after.start() : after.end()] = draw(st.sampled_from(WORDS))
        else:
            found[place:place] = found[place : place + draw(st.integers(0, 64))]
    return bytes(found)


def _nodes(tree: Any) -> Iterator[tuple[Any, Any]]:
    """(container, key) of every value in a tree of dicts and lists."""
    keys = tree if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ()
    for key in list(keys):
        yield tree, key
        yield from _nodes(tree[key])


@st.composite
def trees(draw: st.DrawFn, tree: Any) -> Any:
    """A tree of JSON with values replaced, removed, repeated, or exchanged."""
    tree = deepcopy(tree)
    for _ in range(draw(st.integers(1, 3))):
        nodes = list(_nodes(tree))
        if not nodes:
            break
        (place, key), (other, its) = (draw(st.sampled_from(nodes)) for _ in range(2))
        kind = draw(st.sampled_from(["set", "set", "remove", "repeat", "copy"]))
        if kind == "remove":
            del place[key]
        elif kind == "repeat" and isinstance(place, list):
            place.insert(key, deepcopy(place[key]))
        else:
            place[key] = draw(VALUES) if kind != "copy" else deepcopy(other[its])
    return tree


def _json(tree: Any) -> bytes:
    """JSON text of a tree; a string DEEPn becomes n lists in each other."""
    text = json.dumps(tree)
    return re.sub(
        r'"DEEP(\d+)"', lambda mark: "[" * int(mark[1]) + "]" * int(mark[1]), text
    ).encode()


def _toml(value: Any) -> str:
    """TOML of a value, with tables within one line."""
    if isinstance(value, dict):
        return (
            "{" + ", ".join(f"{json.dumps(key)} = {_toml(one)}" for key, one in value.items()) + "}"
        )
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return (
        '""' if value is None else _json(value).decode().replace("NaN", "nan").replace("Inf", "inf")
    )


def of_json(data: bytes) -> st.SearchStrategy[bytes]:
    """JSON files near this one."""
    return trees(json.loads(data)).map(_json)


def of_toml(data: bytes) -> st.SearchStrategy[bytes]:
    """TOML files near this one."""
    return trees(tomllib.loads(data.decode())).map(
        lambda tree: "\n".join(f"{json.dumps(k)} = {_toml(v)}" for k, v in tree.items()).encode(
            errors="surrogatepass"
        )
    )


def of_lines(data: bytes) -> st.SearchStrategy[bytes]:
    """Files of JSON lines near this one."""
    return trees([json.loads(line) for line in data.splitlines()]).map(
        lambda lines: b"".join(_json(line) + b"\n" for line in lines)
    )


@st.composite
def of_words(draw: st.DrawFn, data: bytes) -> bytes:
    """Texts with other numbers and names in the places of some."""
    parts = re.split(rb"([\w.+-]+)", data)
    for _ in range(draw(st.integers(1, 4))):
        one, other = (2 * draw(st.integers(0, len(parts) // 2 - 1)) + 1 for _ in range(2))
        parts[one] = draw(st.sampled_from([*WORDS, b"1e300", b"0.5", b"-7", parts[other]]))
    return b"".join(parts)


GRAMMARS: dict[str, Callable[[bytes], st.SearchStrategy[bytes]]] = {
    ".json": of_json,
    ".jsonl": of_lines,
    ".toml": of_toml,
    **dict.fromkeys((".txt", ".log", ".csv", ".yaml", ".xml"), of_words),
}
"""Suffix -> strategy for files near a sound one."""
