"""The verbs of `robotctl`, one small file each."""
