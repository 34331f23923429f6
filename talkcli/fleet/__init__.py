"""Robots and desks on an MQTT 5 broker, by means of paho-mqtt (the extra `fleet`).

The bridge runs beside a robot's server, as a client of the server. The desk is a connection below the library's
`Client`. Payloads are lines of the socket's protocol, and the server alone decides about goals. Nothing here prints or
imports the server. The README in this folder describes topics and payloads.
"""
