"""Test of the structure of a record: a Hammerstein system, or a given model, against a table of alternatives.

A Hammerstein system with additive output noise of any colour obeys

    y(k) = c + sum_c sum_i h_c(i) f_c(u_c(k - i)) + v(k).

Functions of inputs, of the predicted output and of time then explain nothing of v. Every row of a table
(`structure_alternatives`) makes some, as products of samples at different lags, which a Wiener system has, and is
judged by one score test (`score_tests`). Finer functions and further lags complete the hypothesis; a negligible share
of the variance is allowed in every test.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import RankError
from optid.identify.informativity.process import Process, processes
from optid.identify.validation.score_tests import FTest, score_test
from optid.identify.validation.structure_alternatives import RANK, alternatives
from optid.identify.validation.structure_design import Design
from optid.identify.validation.structure_hypothesis import Hypothesis, fit_hammerstein, given_model

SIGNIFICANT = 0.01
# share of the residual variance within which functions and filters follow any Hammerstein system, and noise models any
# noise, but for so many rows
NEGLIGIBLE, ROWS = 0.001, 2.0
SAMPLES = 30_000  # samples read, from the beginning of every experiment
SHORTEST = 24  # samples of an experiment that is read


@dataclass(frozen=True)
class Structure:
    """The structure test of a record.

    Attributes:
        ratios: second over first singular value of filters times functions by input, the largest over the outputs.
        p_value: of the hypothesis that the record has Hammerstein structure, up to a negligible share of the variance,
            all tests together (Bonferroni).
        saving: share of the residual variance by which the most significant alternative reduces it.
        alternative: its name.
        p_values: of every alternative by output; empty for an output of which only rounding is left.
    """

    ratios: dict[str, float]
    p_value: float
    saving: float
    alternative: str
    p_values: dict[str, dict[str, float]]

    @property
    def passed(self) -> bool:
        """Whether the hypothesis is kept."""
        return self.p_value >= SIGNIFICANT

    @property
    def finding(self) -> str:
        """The outcome in words."""
        kind = "a Hammerstein system" if any(RANK in each for each in self.p_values.values()) else "the model"
        return f"consistent with {kind}" if self.passed else f"not consistent with {kind}: {self.alternative}"


def structure_test(data: Data, simulated: Sequence[Array] | None = None, found: Sequence[Process] | None = None
                   ) -> Structure:
    """Test whether a record comes from static nonlinearities of the inputs followed by linear dynamics.

    The inputs must not depend on the noise: in closed loop the test is not valid. Of a long record, the first 30,000
    samples are read, spread over the experiments in proportion.

    Args:
        data: the record; NaN = missing.
        simulated: outputs of another model, (N, l) by experiment: the test is then whether functions of the inputs, of
            these outputs, or of time explain its residuals.
        found: `processes(data)`, where they are known.

    Raises:
        RankError: the record does not support a test: it is short, or its inputs move too little.
    """
    if data.n_samples > 1.1 * SAMPLES:
        data = data.split(SAMPLES / data.n_samples)[0]
    found = processes(data) if found is None else found
    kept = [i for i, e in enumerate(data.experiments) if e.n_samples >= SHORTEST]
    if not kept:
        raise RankError(f"no experiment has {SHORTEST} samples: use longer ones")
    data = data.select(experiments=kept)
    tests, ratios = {}, []
    for o, (name, process) in enumerate(zip(data.outputs, found)):
        design = Design.of(data, o, process)
        runs = simulated and [simulated[i][: e.n_samples, o] for i, e in zip(kept, data.experiments)]
        if runs and not all(np.isfinite(run).all() for run in runs):
            raise RankError(f"the test of output {name!r} is not available: its simulation is not finite")
        try:
            hypothesis = given_model(design, runs) if runs else fit_hammerstein(design, process.noise)
            tests[name] = _test(hypothesis)
        except np.linalg.LinAlgError as error:
            raise RankError(f"the test of output {name!r} is not available: {error}") from error
        ratios.append(hypothesis.ratios)
    every = [(test, words) for each in tests.values() for words, test in each.items()]
    if not all(np.isfinite(test.p_value) for test, _ in every):
        raise RankError("the test is not available: a p value is not finite")
    best, words = min(every, key=lambda pair: (pair[0].p_value, -pair[0].saving))
    return Structure(dict(zip(data.inputs, np.max(ratios, axis=0).tolist())), min(1.0, len(every) * best.p_value),
                     best.saving, words,
                     {name: {words: test.p_value for words, test in each.items()} for name, each in tests.items()})


def _test(hypothesis: Hypothesis) -> dict[str, FTest]:
    """Return the test of every alternative that the record distinguishes from the hypothesis."""
    table, regression = alternatives(hypothesis), hypothesis.regression
    if hypothesis.rounding and regression.spare > hypothesis.tangent.shape[1]:  # fewer rows are met by anything
        return {next(iter(table)): FTest()}
    found = {}
    for name, make in table.items():
        columns = make(hypothesis)
        judged = hypothesis.beside(columns)
        spare = judged.regression.spare
        test = score_test(judged.error, judged.tangent, judged.regression.reduce(columns), spare,
                          NEGLIGIBLE + ROWS / max(spare, 1))
        if test is not None:
            found[name] = test
    if not found:
        raise RankError(f"no alternative can be distinguished from the hypothesis in {regression.spare} complete "
                        "samples with these inputs: use a longer record, with more levels and moves")
    return found
