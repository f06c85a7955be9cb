"""Uses of the chain: calibration, horizon of a site, tracks, predictions, the thesis's studies, batches of images."""
