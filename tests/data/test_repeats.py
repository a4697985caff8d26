"""What comes again in a record: equal experiments and periods; they count once, and are left out together."""

import numpy as np
import pytest

import optid
from optid.data.repeats import copies
from optid.identify.blocks import Blocks, join_parts
from optid.identify.informativity import informativity
from optid.identify.search.determined import determined_bases


def switching(rng, samples, held=5):
    return np.repeat(rng.choice([-1.0, 1.0], samples // held + 1), held)[:samples]


def drive(u, noise, rng):
    """The magnitude of the speed of a motor behind a belt, which no linear model follows."""
    v = p = z = 0.0
    y = np.zeros(len(u))
    for k, one in enumerate(u):
        p += 0.3 * v
        v += 0.3 * (one - p - 0.5 * v)
        z += (p - z) / 6
        y[k] = abs(z)
    return y + noise * rng.standard_normal(len(u))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("periods, rest", [(1, 0), (2, 0), (3, 17)])
@pytest.mark.parametrize("gains", [(1.0,), (1.0, 1.5, -0.5)])
def test_copies_are_found_and_make_up_the_record(seed, periods, rest, gains):
    rng = np.random.default_rng(seed)
    base = np.column_stack([switching(rng, 200), 5 + np.cumsum(rng.normal(size=200)) * 0.1])
    base[:, 1] -= np.linspace(0, base[-1, 1] - base[0, 1], 200)
    one = np.vstack([*[base] * periods, base[:rest]])
    groups = copies([gain * one for gain in gains])
    if periods == 1 and len(gains) == 1:
        assert groups == [[(0, 0, 200)]]
    else:
        assert len(groups) == 1 and len(groups[0]) == len(gains) * (periods + bool(rest))
    for i in range(len(gains)):
        inside = sorted(part for group in groups for part in group if part.experiment == i)
        assert [part.first for part in inside] == [0, *(part.last for part in inside[:-1])]
        assert inside[-1].last == len(one)


@pytest.mark.parametrize("seed", range(5))
def test_what_differs_is_no_copy(seed):
    rng = np.random.default_rng(seed)
    several = [switching(rng, 150), rng.normal(size=90), np.cumsum(rng.normal(size=300)), np.zeros(40), np.ones(40)]
    assert sorted(copies([u[:, None] for u in several])) == [[(i, 0, len(u))] for i, u in enumerate(several)]


@pytest.mark.parametrize("samples, count", [(250, 4), (251, 3)])
def test_equal_experiments_are_cut_at_the_same_samples(samples, count):
    rng = np.random.default_rng(0)
    u = switching(rng, samples)
    data = optid.Data([u, 1.5 * u, u[:180]], [rng.normal(size=n) for n in (samples, samples, 180)])
    blocks = Blocks.of(data, count)
    seen = [np.zeros(n, dtype=int) for n in (samples, samples, 180)]
    for b in range(count):
        left, kept = join_parts(data, blocks.parts[b]), blocks.without(b)
        assert {part[1] for part in blocks.parts[b]} == {blocks.parts[b][0].first}
        assert left.n_samples + kept.n_samples <= data.n_samples
        for part in blocks.parts[b]:
            seen[part.experiment][part.first : part.last] += 1
    assert all(np.all(counts == 1) for counts in seen)


def test_few_moves_or_samples_are_left_out_whole():
    rng = np.random.default_rng(0)
    step = np.where(np.arange(300) < 20, 0.0, 1.0)
    for u in (step, switching(rng, 120)):
        data = optid.Data([u] * 4, [rng.normal(size=len(u)) for _ in range(4)])
        assert [len(parts) for parts in Blocks.of(data, 4).parts] == [1] * 4


@pytest.mark.sampled(2)
@pytest.mark.parametrize("seed", range(6))
def test_equal_experiments_of_a_nonlinear_plant_are_open(seed):
    """What linear dynamics miss is the same in all three, and the future of few moves tells it by chance."""
    rng = np.random.default_rng(seed)
    u = [gain * switching(rng_of_moves, 250) for gain in (1.0, 1.5, 0.5)
         for rng_of_moves in [np.random.default_rng(100 + seed)]]
    data = optid.Data(u, [drive(one, 0.005, rng) for one in u], dt=0.02)
    assert informativity(data).loop.word == "open"


def test_a_level_of_each_experiment_hides_what_differs_between_them():
    rng = np.random.default_rng(0)
    u = [gain * switching(rng, 200) for gain in (1.0, 1.5, 0.5)]
    data = optid.Data(u, [rng.normal(size=200) for _ in u])
    assert determined_bases(data, "polynomial:3") == "polynomial:3"
    assert determined_bases(data, "polynomial:3", apart=True) == "linear"
