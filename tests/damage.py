"""Damaged files for tests: copies of good ones with bytes changed, lost, doubled, or swapped for hostile words."""

import json
import random
from collections.abc import Iterator
from typing import Any

HOSTILE: list[Any] = [None, True, -1, 0, 2, 10**400, 1e308, -1e-320, "", "x", "nan", "\x1b[31m", [], [[]], [None], {},
                      {"": 0}, [[1.0], [2.0, 3.0]], [1e200] * 3, "9" * 400, 2**63, -(2**70)]


def bytes_of(good: bytes, count: int, seed: int, ends: int = 600) -> Iterator[bytes]:
    """Yield `count` damaged copies; headers and tails of `ends` bytes are hit more often than the rest."""
    r = random.Random(seed)
    for _ in range(count):
        bad = bytearray(good)
        for _ in range(r.choice((1, 1, 2, 8))):
            if len(bad) < 2:
                break
            zone = r.choice(((0, min(ends, len(bad))), (max(0, len(bad) - ends), len(bad)), (0, len(bad))))
            at = r.randrange(*zone)
            match r.randrange(7):
                case 0:
                    bad[at] ^= 1 << r.randrange(8)
                case 1:
                    bad[at] = r.choice((0, 255, 127, 128, ord("9"), ord("-"), ord("{"), r.randrange(256)))
                case 2:
                    del bad[at:]
                case 3:
                    del bad[at : at + r.randrange(1, 40)]
                case 4:
                    bad[at:at] = bad[at : at + r.randrange(1, 40)]
                case 5:
                    bad[at : at + 8] = r.choice((b"\xff" * 8, b"\0" * 8, b"\xff\xff\xff\x7f" * 2, r.randbytes(8)))
                case 6:
                    bad[at:at] = r.choice((b"9" * 30, b"\x1b[2J", b"\n", b",", b'"', b"\0"))
        yield bytes(bad)


def documents_of(good: Any, count: int, seed: int) -> Iterator[str]:
    """Yield `count` JSON documents in which values are replaced by hostile ones, lost, or nested and doubled."""
    r = random.Random(seed)
    for _ in range(count):
        bad = json.loads(json.dumps(good))
        for _ in range(r.choice((1, 1, 2))):
            places = list(_places(bad))
            holder, key = r.choice(places)
            match r.randrange(4):
                case 0 | 1:
                    holder[key] = r.choice(HOSTILE)
                case 2:
                    del holder[key]
                case 3:
                    holder[key] = [holder[key]] if r.random() < 0.5 else _nested(r.choice((3, 40)))
            if not bad:
                break
        text = json.dumps(bad)
        match r.randrange(6):
            case 0:  # numbers that JSON does not have
                text = text.replace("0", r.choice(("NaN", "Infinity", "1e999")), 1)
            case 1:  # a key twice
                text = text.replace("{", '{"version": 7, "kind": [], ', 1)
        yield text


def _places(document: Any) -> Iterator[tuple[Any, Any]]:
    pairs = document.items() if isinstance(document, dict) else enumerate(document)
    for key, value in pairs:
        yield document, key
        if isinstance(value, dict | list):
            yield from _places(value)


def _nested(depth: int) -> list:
    bottom: list = []
    for _ in range(depth):
        bottom = [bottom]
    return bottom
