"""Tables of the five papers, measured on other scenes: ``lodgs reproduce``.

One module for each paper declares its trainings and tables. The numbers of the papers are means over their
own scenes, so only trends are compared.
"""
