"""Emulated arm: its joints and motions, its safety system, its force sensor and the environment of its tool."""
