"""What this computer has and lacks for a calibration: one small check per file, all of them harmless to repeat."""
