"""The MuJoCo twin: plant, backend, and emulated motors that speak the wire."""
