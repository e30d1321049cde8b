"""Stress tests: experiments that try to make the methods fail, each with claims and verdicts."""
