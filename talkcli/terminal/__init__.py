"""Goals, events and settings as words, in the columns of a terminal.

Pure: objects go in, text comes out; nothing is printed here, and width and time come in as arguments. It may import
protocol, goals and the ground. How something looks to people goes here; when it is shown is the cli's business.
"""
