"""Stored sweeps: design, journal, files, and engines that compute rows."""
