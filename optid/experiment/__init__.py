"""Experiment design: rules an excitation has to obey, the response a record shows, excitations with a promise."""

from optid.experiment.excitation import Excitation, design
from optid.experiment.promises import Promise
from optid.experiment.response import FrequencyResponse, frequency_response
from optid.experiment.rules import Check

__all__ = ["Check", "Excitation", "FrequencyResponse", "Promise", "design", "frequency_response"]
