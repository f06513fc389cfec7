"""Drives of the CiA 402 profile (IEC 61800-7-201) over CANopen (CiA 301)."""
