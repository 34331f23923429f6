"""Goals, the texts that clients ask the server to speak.

These modules are pure: they use no clock, threads or sockets, and receive the time as an argument. From `talkcli` they
import only each other and the modules directly in `talkcli/`. A rule about goals belongs in the module named after its
subject. The messages that contain goals are defined in `protocol`.
"""
