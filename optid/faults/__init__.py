"""Fault models, detection, isolation, diagnosis, monitoring and reconfiguration; names are loaded on first use."""

from optid.lazy import on_first_use

_HOME = {
    "faults": ["Fault"],
    "injection": ["inject", "trajectory", "Surroundings"],
    "hard_over": ["hard_over_test", "HardOver"],
    "whitening": ["whiten", "health", "predictor"],
    "nuisance": ["model_uncertainty"],
    "directions": ["decouple", "direction_of"],
    "screening": ["flat_lines", "check_channels"],
    "signatures": ["dictionary", "Dictionary", "Candidate"],
    "isolability_study": ["isolability", "Isolability"],
    "search.scanning": ["scan", "Scan", "thresholds"],
    "false_alarms": ["Thresholds", "Calibration"],
    "programmes": ["signature_estimate", "membership", "profile"],
    "consistency.bounded_noise": ["Membership"],
    "consistency.profiles": ["Profile"],
    "search.sparse": ["SparseResult"],
    "search.subsets": ["best_subsets", "SubsetSearch"],
    "consistency.waveforms": ["waveform_test", "WaveformTest"],
    "consistency.noise_changes": ["noise_test", "noise_search", "NoiseTest"],
    "monitor.monitoring": ["Monitor"],
    "monitor.events": ["Event"],
    "monitor.arl": ["cusum_arl"],
    "diagnosis.answers": ["Estimate", "FaultAnswer", "Certificate", "Diagnosis", "load_diagnosis"],
    "diagnosis.diagnosing": ["diagnose"],
    "repair.reformulation": ["reformulate", "Reformulation"],
    "repair.virtual_sensor": ["observer", "Observer", "conditional_mean", "subspace_projection"],
    "repair.allocation": ["allocate", "Allocation"],
    "repair.inversion": ["inverse"],
    "repair.ambiguity": ["probe_input"],
    "repair.refitting": ["RefitPrior"],
}

__getattr__, __dir__ = on_first_use(__name__, _HOME)
