"""Training of the event network: clip pool, augmentation, losses of one step, validation, the loop around them."""
