"""What may reach a motor: state machine, admission, limits, shaper, reset routines."""
