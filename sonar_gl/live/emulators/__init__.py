"""Programs that speak the network protocol of a real sonar, for the programs of its users; pings are simulated.

An emulator takes its pings from a `simulated_head`. The modules of messages know the bytes of a protocol, and
nothing of sonars.
"""
