"""Emulated drives that speak the wire byte for byte, in front of the MuJoCo plant."""
