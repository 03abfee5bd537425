"""Mass, viscous and Coulomb friction of a haptic device, from motions that it makes itself."""
