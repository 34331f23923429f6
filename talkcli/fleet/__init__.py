"""A fleet: robots and desks on an MQTT 5 broker, by paho-mqtt (the extra `fleet`).

The bridge stands beside a robot's server, as its client; the desk is a connection below the library's `Client`. A
payload is what would stand on the socket, so neither knows what a goal is or when one is spoken: that stays the
server's. Nothing here prints, and nothing imports the server; topics and payloads are in the README beside this.
"""
