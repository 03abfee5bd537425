"""The emulated arm: its joints and motions, its safety system, what its tool touches and its sensor measures."""
