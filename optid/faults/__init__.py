"""Faults: what can break, what the outputs would show of it, who is to blame, and what is left.

The public names are loaded on first use.
"""

from optid.lazy import on_first_use

_HOME = {
    "Fault": "faults",
    "inject": "injection",
    "hard_over_test": "hard_over",
    "HardOver": "hard_over",
    "trajectory": "injection",
    "whiten": "whitening",
    "health": "whitening",
    "predictor": "whitening",
    "model_uncertainty": "nuisance",
    "flat_lines": "screening",
    "check_channels": "screening",
    "dictionary": "signatures",
    "Dictionary": "signatures",
    "Candidate": "signatures",
    "Isolability": "isolability",
    "scan": "scanning",
    "Scan": "scanning",
    "pairs": "pair_search",
    "PairSearch": "pair_search",
    "thresholds": "calibration",
    "Thresholds": "calibration",
    "signature_estimate": "programmes",
    "SparseResult": "sparse",
    "polish": "subsets",
    "SubsetSearch": "subsets",
    "waveform_test": "waveforms",
    "WaveformTest": "waveforms",
    "noise_test": "noise_changes",
    "noise_search": "noise_changes",
    "NoiseTest": "noise_changes",
    "Estimate": "answers",
    "Answer": "answers",
    "Certificate": "answers",
    "Diagnosis": "answers",
    "load_diagnosis": "answers",
    "diagnose": "diagnosis",
}

__getattr__, __dir__ = on_first_use(__name__, _HOME)
