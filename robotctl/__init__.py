"""Real-robot control: one loop for the MuJoCo twin and for CAN hardware."""

__version__ = "0.1.0"
