"""The rig and what it projects: pinholes with lens distortion, calibration files, patterns, frame
order."""
