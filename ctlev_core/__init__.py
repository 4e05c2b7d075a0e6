"""ctlev: labelled event-camera data from a fine-tuned image-diffusion model."""

__version__ = "0.1.0"
