"""The safety programme: faults provoked to order, stops measured on the plant's true state, and the soak."""
