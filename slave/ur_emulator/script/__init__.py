"""Programs of the emulated controller: how they come in, how they run, and the control script of ur_rtde."""
