"""Identification of a haptic device's mass, viscous and Coulomb friction from its own motions."""
