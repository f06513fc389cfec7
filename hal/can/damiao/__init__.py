"""DAMIAO drives (DM-J43xx, DM-80xx and relatives)."""
