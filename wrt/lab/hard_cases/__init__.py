"""Rays on which intersection tests fail, and tests of wrt and other libraries with them."""
