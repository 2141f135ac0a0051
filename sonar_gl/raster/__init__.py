"""Scene to samples: levels of detail, culling, drawing."""
