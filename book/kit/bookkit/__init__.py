"""The book's own tools: scenarios, published values, verdicts, studies, figures and digests.

The chapters, the studies and the book's checks use them; the library ``distfilt`` knows nothing of
them.
"""
