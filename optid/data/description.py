"""A record at a glance: its experiments, its sampling, and each channel's range, levels and missing samples."""

from dataclasses import dataclass

from optid.data.channels import MOST_LEVELS, Channel

MOST_EXPERIMENTS = 10  # that are listed


@dataclass(frozen=True, repr=False)
class Description:
    """What `Data.describe` returns; printing it shows a table.

    Attributes:
        name: name of the data set.
        dt: sampling time.
        lengths: samples of each experiment.
        starts: time of the first sample of each experiment.
        channels: figures of each channel over all experiments, inputs first.
    """

    name: str
    dt: float
    lengths: tuple[int, ...]
    starts: tuple[float, ...]
    channels: tuple[Channel, ...]

    def __str__(self) -> str:
        lines = [f"{self.name or 'Record'}: {sum(self.lengths)} samples every {self.dt:g}"]
        if len(self.lengths) > MOST_EXPERIMENTS:
            lines.append(f"  {len(self.lengths)} experiments of {min(self.lengths)} to {max(self.lengths)} samples")
        for k, (samples, start) in enumerate(zip(self.lengths, self.starts) if len(lines) < 2 else ()):
            label = f"experiment {k + 1}: {samples} samples " if len(self.lengths) > 1 else ""
            lines.append(f"  {label}from {start:.10g} to {start + (samples - 1) * self.dt:.10g}")
        table = [("channel", "role", "unit", "low", "high", "mean", "std", "levels", "missing")]
        for c in self.channels:
            levels = str(c.levels) if c.levels <= MOST_LEVELS else f"over {MOST_LEVELS}"
            table.append((c.name, c.role, c.unit, *(f"{value:.4g}" for value in (c.low, c.high, c.mean, c.std)), levels,  # pyright: ignore[reportArgumentType]
                          f"{c.missing:.2%}" if c.missing else "none"))
        widths = [max(map(len, column)) for column in zip(*table)]
        for row in table:
            words = [f"{cell:<{w}}" if k < 3 else f"{cell:>{w}}" for k, (cell, w) in enumerate(zip(row, widths))]
            lines.append("  ".join(words).rstrip())
        return "\n".join(lines)

    __repr__ = __str__
