"""From a record to an answer: a set of explanations with probabilities, sizes, onsets, words and pictures."""
