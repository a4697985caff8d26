"""The frequency response of a record: the best linear approximation for its excitation."""

from dataclasses import dataclass

import numpy as np

from optid.arrays import Array, check_integer
from optid.data.record import Data
from optid.errors import DataError

SILENT = 1e-4  # input power, relative to its largest over frequency, below which there is no estimate


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """A measured frequency response.

    Attributes:
        frequency: (F,) in 1/unit of dt, from the first bin above zero to half the sampling rate.
        response: (F, l, m) complex; NaN where the inputs have no power.
        coherence: (F, l) share of the output power that the inputs explain linearly, 0 to 1.
        disturbance: (F, l) power spectral density of the rest, squared unit per unit of frequency.
        segments: number of segments averaged.
    """

    frequency: Array
    response: np.ndarray
    coherence: Array
    disturbance: Array
    segments: int

    def at(self, frequency: Array) -> np.ndarray:
        """Return the response (K, l, m) at some frequencies (K,), linear between the bins, constant beyond."""
        known = ~np.isnan(self.response).any(axis=(1, 2))
        found = np.empty((len(frequency), *self.response.shape[1:]), dtype=complex)
        for i, c in np.ndindex(*self.response.shape[1:]):
            found[:, i, c] = np.interp(frequency, self.frequency[known], self.response[known, i, c])
        return found

    def gain(self, frequency: Array, c: int) -> Array:
        """Return the root mean square over the outputs of |G| / max |G| of input c at some frequencies (K,)."""
        largest = np.nanmax(np.abs(self.response[:, :, c]), axis=0)
        return np.sqrt(np.mean((np.abs(self.at(frequency)[:, :, c]) / largest) ** 2, axis=1))


def frequency_response(data: Data, segment: int | None = None) -> FrequencyResponse:
    """Measure the frequency response G = S_yu S_uu^-1 by averaged spectra (Welch 1967; Bendat and Piersol).

    Hann windows overlap by half; segments with a missing sample are left out; experiments are averaged. By default a
    segment has a quarter of the samples of the longest experiment (less with four inputs or more), at least 32.

    Raises:
        StructureError: a segment of fewer than 8 samples.
        DataError: fewer than 2 m complete segments, or inputs that are collinear at every frequency.
    """
    longest = max(e.n_samples for e in data.experiments)
    size = max(32, longest // max(4, data.m + 1)) if segment is None else check_integer(segment, "segment", 8)
    window = np.hanning(size + 1)[:-1]
    m, l = data.m, data.l  # noqa: E741 - the field's letter
    sums, count = np.zeros((size // 2 + 1, m + l, m + l), dtype=complex), 0
    for samples in data.records:
        samples = samples - np.nanmean(samples, axis=0)
        for start in range(0, len(samples) - size + 1, max(1, size // 2)):
            part = samples[start : start + size]
            if np.isnan(part).any():
                continue
            spectrum = np.fft.rfft(window[:, None] * part, axis=0)
            sums += spectrum[:, :, None] * np.conj(spectrum[:, None, :])
            count += 1
    if count < 2 * m:
        raise DataError(f"{count} complete segments of {size} samples, fewer than {2 * m} for {m} inputs: use a longer "
                        "record without gaps or a smaller segment.")
    spectra = sums[1:] * (2 * data.dt / (count * np.sum(window**2)))
    frequency = np.arange(1, size // 2 + 1) / (size * data.dt)
    uu, yu = spectra[:, :m, :m], spectra[:, m:, :m]
    yy = np.real(np.diagonal(spectra[:, m:, m:], axis1=1, axis2=2))
    power = np.real(np.diagonal(uu, axis1=1, axis2=2))
    excited = np.flatnonzero((power > SILENT * power.max(axis=0)).all(axis=1))
    scale = np.sqrt(power[excited])
    values = np.linalg.svd(uu[excited] / (scale[:, :, None] * scale[:, None, :]), compute_uv=False)
    k = excited[values[:, 0] < 1e6 * values[:, -1]]  # where the inputs are not collinear
    if not k.size:
        raise DataError("the inputs are collinear or without power at every frequency.")
    response = np.full((frequency.size, l, m), np.nan, dtype=complex)
    coherence, disturbance = np.zeros((frequency.size, l)), yy.copy()
    response[k] = np.linalg.solve(uu[k].swapaxes(1, 2), yu[k].swapaxes(1, 2)).swapaxes(1, 2)
    explained = np.real(np.sum(response[k] * np.conj(yu[k]), axis=2))
    coherence[k] = np.clip(explained / np.where(yy[k] > 0, yy[k], 1.0), 0.0, 1.0)
    # The estimate takes m of the averaged segments' degrees of freedom.
    disturbance[k] = yy[k] * (1 - coherence[k]) * count / (count - m)
    return FrequencyResponse(frequency, response, coherence, disturbance, count)
