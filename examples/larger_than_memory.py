"""A record on disk that is read chunk by chunk: memory is bounded by the chunk, not by the record.

The file here has two million samples so that the example is quick; nothing changes for two billion.
"""

import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

import optid

SAMPLES, PART = 2_000_000, 250_000


def write(path: Path) -> None:
    """Write u and y of a dead zone before second-order dynamics, part by part, as float32 (N, 2)."""
    rng, memory = np.random.default_rng(0), np.zeros(2)
    file = np.lib.format.open_memmap(path, mode="w+", dtype=np.float32, shape=(SAMPLES, 2))
    last = 0.0
    for start in range(0, SAMPLES, PART):
        u = rng.uniform(-1, 1, PART).astype(np.float32)
        w = np.sign(u) * np.maximum(np.abs(u) - 0.25, 0.0)
        x = 16 / 15 * w + 0.8 * np.concatenate([[last], w[:-1]]) + 0.1 * rng.standard_normal(PART)
        y, memory = lfilter([1.0], [1.0, -1.5, 0.7], x, zi=memory)
        file[start : start + PART], last = np.column_stack([u, y]), w[-1]
    file.flush()


def main() -> dict[str, float]:
    """Return a, b and the time of the fit."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "record.npy"
        write(path)
        stream = optid.open_stream(path, inputs={"u": 0}, outputs={"y": 1}, dt=0.1)
        optid.fit(optid.Data(*next(iter(stream)), dt=0.1), na=2, nb=2, basis="triangular:8")  # compiles the loops
        clock = time.perf_counter()
        fit = optid.fit(stream, na=2, nb=2, basis="triangular:8")
        seconds = time.perf_counter() - clock
    print(fit.model)
    print(f"{fit.figures['rows']} rows in {seconds:.2f} s, {fit.solution.status}: {fit.solution.bound.reason}")
    return {"a1": fit.model.a[0], "a2": fit.model.a[1], "b1 / b0": fit.model.b[0][1] / fit.model.b[0][0],
            "rows": fit.figures["rows"], "seconds": seconds}


if __name__ == "__main__":
    main()
