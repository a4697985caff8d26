"""Experiment design: rules an excitation has to obey, the response a record shows, excitations with a promise."""

from optid.identify.design.excitation import Excitation, Promise, design
from optid.identify.design.response import FrequencyResponse, frequency_response
from optid.identify.design.rules import Check

__all__ = ["Check", "Excitation", "FrequencyResponse", "Promise", "design", "frequency_response"]
