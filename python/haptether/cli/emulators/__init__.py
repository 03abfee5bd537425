"""Emulated devices as commands."""
