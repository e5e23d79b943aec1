"""Hold any ``findFundamentalMat`` against the cv2 that is installed.

``COMPAT_IMPLEMENTATION=module:function python -m pytest compat``
"""
