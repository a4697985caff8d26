"""Experiment design: rules of excitation, frequency responses, excitations."""

from optid.identify.design.excitation import Excitation, design
from optid.identify.design.response import FrequencyResponse, frequency_response
from optid.identify.design.rules import Check

__all__ = ["Check", "Excitation", "FrequencyResponse", "design", "frequency_response"]
