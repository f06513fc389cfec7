"""Tasks and policies."""
