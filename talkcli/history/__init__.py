"""The history of ended goals, which `talk serve --history` keeps in an SQLite file.

`rows` is pure: it turns goals into rows of the file's table, and applies the filters of a `log` request. `file` writes
and searches the file, and is the only module that imports sqlite3. The server calls it in threads of their own
(`server.history`). `talk log` calls it if no server is running.
"""
