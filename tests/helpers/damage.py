"""Damaged copies of files, with bytes changed, lost or doubled."""

import random
from collections.abc import Iterator


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
