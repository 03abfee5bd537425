"""RTDE of the emulated controller: frames of the protocol, sessions of its clients, variables."""
