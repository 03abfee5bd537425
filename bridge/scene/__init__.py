"""Scenes: tables, checks, the numbers that the Rust side takes, runs and sweeps."""
