"""Uniform sampling: the check of stamps, what is wrong with them, and the repairs that a user asks for."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.data.reading.clock import seconds
from optid.data.reading.format import Format
from optid.errors import DataError

MOST_INSERTED = 1 << 20  # missing samples that gaps may add beyond twenty times the samples of a record
COARSE = 0.2  # share of stamps equal to the one before from which the resolution of the stamps is too low
FEWEST = 10  # stamps from which that is told
LINE = 1 << 16  # stamps to which a line is fitted
WHOLE = 0.1  # deviation of a step from a multiple of the median step up to which rows are said to be lost


@dataclass(frozen=True)
class Piece:
    """Samples without a gap."""

    stamp: Any  # of the first sample
    u: np.ndarray  # (N, m)
    y: np.ndarray  # (N, l)
    times: np.ndarray | None = None  # (N,) seconds after the first stamp, where they are irregular


def uniform_step(stamps: np.ndarray, tolerance: float, label: str, step: float | None = None, first: int = 0
                 ) -> float | None:
    """Check that time stamps (N,) are uniform and return the sampling time, None for a single stamp.

    No step may deviate by more than the relative tolerance from `step`, by default the median; `first` is the index of
    the first stamp in the whole record. `DataError`: a stamp is missing, time does not increase, or a step deviates;
    the message has the sample, the step found there, the median step, the likely reason and what to type.
    """
    _check_whole(stamps, label, first)
    if stamps.size < 2:
        return None
    # Differences of dates are exact in nanoseconds; seconds since 1970 would lose the digits of fast sampling.
    steps = seconds(np.diff(stamps))
    median = float(np.median(steps)) if step is None else step
    if stamps.size >= FEWEST and np.mean(steps == 0) > COARSE:
        raise _coarse(stamps, steps, label)
    if median <= 0:
        raise DataError(f"{label}: time does not increase (median step {median:g}); sort the rows by time.")
    bad = np.abs(steps - median) > tolerance * median
    if bad.any():
        raise _not_uniform(stamps, steps, median, bad, tolerance, label, first)
    return sampling_time(stamps)


def sampling_time(stamps: np.ndarray, positions: np.ndarray | None = None) -> float:
    """Return the sampling time from stamps (N,) of samples at whole positions (N,), 0, 1, ... when not given.

    It is the slope of the line of least squares.

    Of the numbers within three standard errors it is the one with the fewest digits: stamps that are rounded or
    jitter hide no digits of the sampling time.
    """
    every = max(1, stamps.size // LINE)
    k = (np.arange(0, stamps.size, every) if positions is None else positions[::every]).astype(float)
    k, t = k - k.mean(), seconds(stamps[::every] - stamps[0])
    square = float(k @ k)
    if not square:
        return float("nan")
    slope = float(k @ t) / square
    deviation = t - t.mean() - slope * k
    error = 3 * float(np.sqrt((deviation @ deviation) / max(len(k) - 2, 1) / square)) + 5e-13 * abs(slope)
    for digits in range(1, 16):
        if abs((near := float(f"{slope:.{digits}g}")) - slope) <= error:
            return near
    return slope


def agreed_step(found: float | None, dt: float | None, tolerance: float, label: str) -> float | None:
    """Return dt if given, else the step found, rounded to 12 digits; `DataError` if they differ."""
    if found is None:
        return dt
    if dt is None:
        return float(f"{found:.12g}")
    if abs(found - dt) > max(tolerance, 1e-3) * dt:
        raise DataError(f"{label}: dt = {dt:g}, but the time stamps step by {found:.6g}. Leave dt out to use the "
                        "stamps (mind their unit), pass time=False to ignore them, or resample for the model.")
    return dt


def regular(stamps: np.ndarray, u: np.ndarray, y: np.ndarray, dt: float | None, how: Format, label: str
            ) -> tuple[list[Piece], float | None, list[str]]:
    """Return uniform pieces of a record, their sampling time, and what was done.

    The record is stamps (N,), u (N, m), y (N, l); `dt` is what the user gave, `how` has the repairs asked for.
    `DataError`: stamps that are not uniform, where no repair was asked for or none helps.
    """
    _check_whole(stamps, label, 0)
    if how.resample is not None:
        return _resampled(stamps, u, y, how, label)
    if dt is not None and share_of_repeats(stamps) > COARSE:
        return [Piece(stamps[0], u, y)], dt, [_check_spread(stamps, dt, label)]
    if how.gaps is None or stamps.size < 2:
        said = []
        if share_of_repeats(stamps) > COARSE and _are_copies(stamps, u, y):
            raise DataError(f"{label}: rows that share a time stamp are equal: pass gaps='missing' to count each once, "
                            "or dt= where they are samples of their own.")
        if stamps.size > 1 and stamps[1] < stamps[0] and (seconds(np.diff(stamps)) < 0).all():
            stamps, u, y = stamps[::-1], u[::-1].copy(), y[::-1].copy()
            said = ["the newest sample came first: the rows are turned round"]
        step = uniform_step(stamps, how.time_tolerance, label)
        drift = 0.0 if step is None else float(np.ptp(seconds(stamps - stamps[0]) - step * np.arange(stamps.size)))
        if step is not None and drift > max(1.0, 3 * how.time_tolerance) * step:
            said.append(f"clock: the stamps leave an even grid of {step:g} s by up to {drift:.3g} s")
        return [Piece(stamps[0], u, y)], step, said
    if how.gaps == "stamps":
        return _as_stamped(stamps, u, y, how, label)
    return _without_gaps(stamps, u, y, how, label)


def share_of_repeats(stamps: np.ndarray) -> float:
    """Return the share of stamps that are equal to the one before."""
    return float(np.mean(stamps[1:] == stamps[:-1])) if stamps.size > 1 else 0.0


def _are_copies(stamps: np.ndarray, u: np.ndarray, y: np.ndarray) -> bool:
    """Whether all rows with the stamp of the row before are equal to it, on a record that is not constant."""
    same, equal = stamps[1:] == stamps[:-1], _equal_the_row_before(u) & _equal_the_row_before(y)
    return bool(equal[same].all()) and not equal[~same].all()


def _equal_the_row_before(samples: np.ndarray) -> np.ndarray:
    """Return which rows (N-1,), from the second on, equal the one before; missing samples equal each other."""
    equal = np.ones(len(samples) - 1, dtype=bool)
    for column in samples.T:
        equal &= (column[1:] == column[:-1]) | (np.isnan(column[1:]) & np.isnan(column[:-1]))
    return equal


def _check_whole(stamps: np.ndarray, label: str, first: int) -> None:
    here = np.isfinite(stamps)
    if not here.all():
        raise DataError(f"{label}: the time stamp of sample {first + int(np.argmin(here))} is missing.")


# -- what is wrong


def _not_uniform(stamps: np.ndarray, steps: np.ndarray, median: float, bad: np.ndarray, tolerance: float, label: str,
                 first: int) -> DataError:
    k = int(np.argmax(bad))
    count, size = int(bad.sum()), steps[bad]
    summer = _summer_time(stamps, steps, median)
    if summer is not None:
        k = summer
        reason = ("Daylight saving time ends there" if steps[k] < median else
                  "Daylight saving time begins there, or an hour was lost")
        remedy = "the stamps are local. Pass their time_zone='Europe/Berlin' or whichever it is"
        remedy += " or gaps='missing'." if steps[k] > median else "."
    elif (size < 0).any():
        back = int(np.argmax(steps < 0))
        reason = "The clock runs backwards " + ("there" if back == k else f"at sample {first + back + 1}")
        remedy = "sort the rows by time, or cut the record at that row."
    else:
        multiples = np.round(size / median)
        whole = np.abs(size / median - multiples) <= max(WHOLE, tolerance)
        lost, twice = int(np.sum((multiples - 1)[multiples > 1])), int(np.sum(multiples == 0))
        if whole.all() and (multiples != 1).all():
            rows = [f"{lost} row{'s' if lost > 1 else ''} seem{'s' if lost == 1 else ''} to be lost"] * bool(lost)
            rows += [f"{twice} stamp{'s' if twice > 1 else ''} come{'s' if twice == 1 else ''} twice"] * bool(twice)
            reason = " and ".join(rows)
            remedy = ("pass gaps='missing' to count lost samples as missing (a row that is repeated counts once), or "
                      f"resample='{median:.6g}s' to fill them.")
        elif (np.abs(size - median) < 0.5 * median).all():
            needed = np.ceil(np.max(np.abs(size - median)) / median * 100) / 100
            reason, remedy = "The clock has jitter", f"pass time_tolerance={needed:g} to accept it."
        else:
            reason = "The sampling is irregular"
            remedy = (f"pass resample='{median:.6g}s' to bring the record onto a uniform grid, or gaps='stamps' to "
                      "keep the stamps for a process in continuous time ('process.exact').")
    return DataError(
        f"{label}: time stamps are not uniform. Sample {first + k + 1} (t = {stamps[k + 1]}) comes {steps[k]:.6g} "
        f"after the one before, the median step is {median:.6g} ({count} step(s) deviate by more than {tolerance:.2%}"
        f"). {reason}: {remedy} If the stamps are wrong pass time=False and dt=.")


def _summer_time(stamps: np.ndarray, steps: np.ndarray, median: float) -> int | None:
    """Return the step at which local dates jump by an hour in a night to Sunday; None where none does."""
    if stamps.dtype.kind != "M":
        return None
    jump = np.flatnonzero(np.abs(np.abs(steps - median) - 3600) <= min(0.01 * median, 60.0) + 1e-6)
    for k in jump:
        day = stamps[k + 1].astype("M8[D]")
        hour = float((stamps[k + 1] - day) / np.timedelta64(1, "h"))
        if (int(day.astype(int)) + 4) % 7 == 0 and hour <= 4.0:  # 1970-01-01 was a Thursday
            return int(k)
    return None


def _coarse(stamps: np.ndarray, steps: np.ndarray, label: str) -> DataError:
    """Return the error about stamps that several rows share."""
    runs = np.diff(np.concatenate([[0], np.flatnonzero(steps) + 1, [stamps.size]]))
    if runs.size < 2:
        return DataError(f"{label}: all {stamps.size} stamps are equal; pass time=False and dt=.")
    resolution = float(np.min(np.abs(steps[steps != 0])))
    inner = runs[1:-1] if runs.size > 2 else runs
    dt = resolution / float(np.median(inner))
    shared = f"{int(np.median(inner))} rows share each" if inner.min() == inner.max() else \
        f"{inner.min()} to {inner.max()} rows share a"
    text = f"{label}: {shared} time stamp; the stamps have a resolution of {resolution:g} s. "
    try:
        _check_spread(stamps, dt, label)
    except DataError:
        return DataError(text + "Rows were lost, or the sampling is irregular: pass time=False and dt= to ignore the "
                         "stamps.")
    return DataError(text + f"Pass dt={dt:.6g} to spread the samples evenly.")


def _check_spread(stamps: np.ndarray, dt: float, label: str) -> str:
    """Return a finding where samples every dt fit stamps of a low resolution, else raise a `DataError`."""
    t = seconds(stamps - stamps[0])
    steps = np.diff(t)
    resolution = float(np.min(steps[steps > 0], initial=np.inf))
    late = t - dt * np.arange(t.size)
    if (steps < 0).any() or late.max() - late.min() > resolution * (1 + 1e-9) + 0.01 * dt:
        k = int(np.argmax(np.abs(late)))
        raise DataError(f"{label}: dt={dt:g} does not fit the time stamps: sample {k} would be at {dt * k:.6g} s after "
                        f"the first one, its stamp says {t[k]:.6g} s. Rows were lost, or dt is wrong; time=False "
                        "ignores the stamps.")
    return f"clock: the stamps have a resolution of {resolution:g} s; the samples are spread evenly, every {dt:g} s"


# -- repairs


def _as_stamped(stamps: np.ndarray, u: np.ndarray, y: np.ndarray, how: Format, label: str
                ) -> tuple[list[Piece], float, list[str]]:
    """Keep samples at their stamps, which must increase; those that are uniform are regular."""
    steps = seconds(np.diff(stamps))
    median = float(np.median(steps))
    bad = steps <= 0
    if bad.any():
        raise _not_uniform(stamps, steps, median, bad, how.time_tolerance, label, 0)
    if not np.any(np.abs(steps - median) > how.time_tolerance * median):
        return [Piece(stamps[0], u, y)], sampling_time(stamps), []
    said = f"clock: the stamps are irregular, {steps.min():.4g} to {steps.max():.4g} s apart: they are kept as they are"
    return [Piece(stamps[0], u, y, seconds(stamps - stamps[0]))], float(f"{median:.12g}"), [said]


def _without_gaps(stamps: np.ndarray, u: np.ndarray, y: np.ndarray, how: Format, label: str
                  ) -> tuple[list[Piece], float, list[str]]:
    steps = seconds(np.diff(stamps))
    median = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    multiples = np.round(steps / median) if median else steps
    off = np.abs(steps - multiples * median) > how.time_tolerance * median + 1e-9 * median
    if not median or (steps < 0).any() or off.any():
        bad = off | (steps < 0) if median else steps <= 0
        raise _not_uniform(stamps, steps, median or np.nan, bad, how.time_tolerance, label, 0)
    positions = np.concatenate([[0], np.cumsum(multiples.astype(np.int64))])
    dt = sampling_time(stamps, positions)
    once, rows = np.unique(positions, return_index=True)
    samples = np.hstack([u, y])
    findings = []
    if twice := stamps.size - once.size:
        other = (multiples == 0) & ~_equal_the_row_before(samples)
        findings.append(f"{twice} row{'s' if twice > 1 else ''} with the stamp of the row before: "
                        + ("where the values differ the samples are missing" if other.any() else "counted once"))
        samples[rows[np.searchsorted(once, positions[1:][other])]] = np.nan
    samples, m = samples[rows], u.shape[1]
    if how.gaps == "experiments":
        cuts = np.flatnonzero(np.diff(once) > 1) + 1
        bounds = [0, *cuts.tolist(), once.size]
        if cuts.size:
            findings.append(f"{cuts.size} gap{'s' if cuts.size > 1 else ''} in time: an experiment begins after each")
        return [Piece(stamps[rows[a]], samples[a:b, :m], samples[a:b, m:]) for a, b in zip(bounds, bounds[1:])], dt, \
            findings
    total = int(once[-1]) + 1
    if total - once.size > MOST_INSERTED + 20 * once.size:
        raise DataError(f"{label}: the gaps in time would become {total - once.size} missing samples between "
                        f"{once.size}. Pass gaps='experiments', or cut the record.")
    whole = np.full((total, samples.shape[1]), np.nan)
    whole[once] = samples
    if lost := total - once.size:
        findings.append(f"{lost} sample{'s' if lost > 1 else ''} lost in {int(np.sum(np.diff(once) > 1))} gap(s) of "
                        "the clock: counted as missing")
    return [Piece(stamps[0], whole[:, :m], whole[:, m:])], dt, findings


def _resampled(stamps: np.ndarray, u: np.ndarray, y: np.ndarray, how: Format, label: str
               ) -> tuple[list[Piece], float, list[str]]:
    dt = float(how.resample)
    t = seconds(stamps - stamps[0])
    if (np.diff(t) < 0).any():
        steps = np.diff(t)
        raise _not_uniform(stamps, steps, float(np.median(steps)), steps < 0, how.time_tolerance, label, 0)
    count = int(np.floor(t[-1] / dt + 1e-9)) + 1
    if count > MOST_INSERTED + 20 * t.size:
        raise DataError(f"{label}: resample={dt:g} s would make {count} samples of {t.size}; is the unit right?")
    if count < 2:
        raise DataError(f"{label}: the record lasts {t[-1]:g} s, less than resample={dt:g} s.")
    grid = dt * np.arange(count)
    whole, bridged = np.empty((count, u.shape[1] + y.shape[1])), 0
    for c, column in enumerate(np.hstack([u, y]).T):
        here = np.isfinite(column)
        where, values = t[here], column[here]
        if not where.size:
            whole[:, c] = np.nan
            continue
        step = float(np.median(np.diff(where))) if where.size > 1 else dt
        last = np.searchsorted(where, grid + 1e-9 * dt, "right") - 1
        held = c < u.shape[1]
        whole[:, c] = values[np.maximum(last, 0)] if held else np.interp(grid, where, values)
        if dt > 1.5 * step:
            bins = np.round(where / dt).astype(int)
            kept = bins < count
            number = np.bincount(bins[kept], minlength=count)
            mean = np.bincount(bins[kept], values[kept], count) / np.maximum(number, 1)
            whole[:, c] = np.where(number > 0, mean, whole[:, c])
        after = where[np.minimum(last + 1, where.size - 1)]
        far = (after - where[np.maximum(last, 0)] > 1.5 * max(step, dt) + 1e-9) & (grid > where[np.maximum(last, 0)]
                                                                                  + 1e-9 * dt)
        far |= (grid < where[0] - 1e-9 * dt) | (grid > where[-1] + max(step, dt))
        whole[grid < where[0] - 1e-9 * dt, c] = np.nan
        bridged = max(bridged, int(far.sum()))
        if how.gaps == "missing":
            whole[far, c] = np.nan
    m = u.shape[1]
    findings = [f"resampled every {dt:g} s"]
    if bridged:
        findings.append(f"{bridged} samples inside gaps of the clock are "
                        + ("missing" if how.gaps == "missing" else "held or interpolated"))
    return [Piece(stamps[0], whole[:, :m], whole[:, m:])], dt, findings
