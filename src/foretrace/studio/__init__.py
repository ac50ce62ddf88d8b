"""The studio in a browser, and predictions, plans and monitors over HTTP.

What a visitor has chosen and what follows from it is in `session`, which knows no browser; `page` draws it.
"""
