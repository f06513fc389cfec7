"""CAN: channels, transport, wire protocols and the drivers on top."""
