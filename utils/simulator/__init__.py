"""Event-camera simulator with exact ground truth: textured planes, smooth motion, contrast-threshold events."""
