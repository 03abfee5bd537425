"""Commands that describe, draw and export the recordings of master and slave."""
