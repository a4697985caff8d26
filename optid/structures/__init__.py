"""Structures of programmes that special methods exploit, as numbers."""
