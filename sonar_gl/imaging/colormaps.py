"""The colour maps of this simulator. Imports nothing, since the command line names them in its help."""

# Colours of the kinds that sonar vendors' viewers offer, evenly spread from 0 to full scale and interpolated. They look
# alike, but are nobody's own tables. Each begins black and ends nearly white; each of its 256 colours is brighter than
# the one before, so that brightness can be read as counts. Between two anchors of nearly the same brightness,
# neighbouring colours would be rounded to the same bytes.
ANCHORS = {
    "gray": "000000 ffffff",
    "copper": "000000 40200c 8c4a18 d08840 f4c888 fff8e8",
    "amber": "000000 4c2600 985000 dc8800 ffbe30 fff0b0",
    "ice": "000000 0a2048 185090 3c94c8 96d4ec f4ffff",
}
DEFAULT_COLORMAP = "copper"  # what most viewers show at first
# By the help and on the page; `colorize` also knows the others of OpenCV.
OFFERED = (*ANCHORS, "jet", "viridis")
