"""From images to views, and from recordings to interactions: calibration, masks, markers, recordings."""
