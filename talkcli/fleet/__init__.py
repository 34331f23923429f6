"""Robots and their operators, connected through an MQTT 5 broker.

A bridge runs beside each robot's server and connects to it as a client. On the operator's side, a desk connects the
library's `Client` to robots. Requests and replies have the same form as on the server's socket, and only the server
decides about goals. These modules don't print anything and don't import the server. The README in this folder describes
topics and payloads. paho-mqtt is required (the extra `fleet`).
"""
