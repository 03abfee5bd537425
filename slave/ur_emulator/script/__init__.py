"""Programs of the emulated controller: their arrival, their execution, and the control script of ur_rtde."""
