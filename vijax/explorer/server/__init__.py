"""The server of a page: sessions, requests, jobs in threads and processes, and compilation ahead of requests.

Begin with `server`.
"""
