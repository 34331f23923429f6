"""The library: from nothing to a server that has greeted, requests out, replies and events in, goals as handles.

It blocks, in any number of threads, and every start of a command pays for it: neither click nor asyncio, nothing heavy.
It may import protocol, goals and the ground, and of terminal what makes others' words fit to be shown. What a program
can ask for goes to `client`, what it can do with one goal to `goal`; another way to a server is another `Connection`,
beside that by a socket in `connection`.
"""
