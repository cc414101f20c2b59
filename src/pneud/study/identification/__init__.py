"""What a rig is like, from logs of any run: its parameters with intervals, and what a log cannot tell.

The chambers are simulated under the measured motion and command, the forces under the measured motion; so
neither needs the other to be right. Needs scipy.
"""
