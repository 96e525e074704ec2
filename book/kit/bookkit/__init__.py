"""The book's own tools: scenarios, published values, verdicts, studies, figures and digests.

They are used by chapters, studies and the checks of the book. The library ``distfilt`` does not
depend on them.
"""
