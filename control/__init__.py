"""The fixed-rate loop, and the processes and shared memory around it."""
