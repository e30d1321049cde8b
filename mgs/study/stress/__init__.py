"""Where methods fail: experiments as data, with hypotheses that were fixed before and verdicts that
follow from numbers."""
