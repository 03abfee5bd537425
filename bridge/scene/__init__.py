"""Scenes: tables, checks, numbers for the Rust side, runs and sweeps."""
