"""From an image and its camera to a prediction: backbone, head, and the two put together."""
