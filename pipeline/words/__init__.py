"""Sentences: results as text, the same for screen, report, workbench, JSON and notebook.

`verdict` says how far a run is off in one to three sentences, `diagnosis` lists its lines, `effects` and
`errors` have the parts, and `objects` adds the sentences to the JSON of `slip diagnose`.
"""
