"""The formats of files in which pings are kept. Imports nothing, since the command line names them in its help."""

STILLS = ("png", "npz")  # one file for each ping
FILMS = ("gif", "mp4")  # one file for all; of 8 bits at most
FORMATS = (*STILLS, *FILMS)
