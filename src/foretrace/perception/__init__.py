"""From pictures to views, and from films to interactions: calibration, masks, markers, recordings."""
