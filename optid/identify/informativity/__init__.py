"""What a record can tell, computed before any model: dead time, feedback, effects of inputs, excitation."""
