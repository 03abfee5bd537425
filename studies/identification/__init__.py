"""Identification of mass, viscous and Coulomb friction of a haptic device from its own motions."""
