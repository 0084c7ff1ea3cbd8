"use strict";
// Kept by address and port, which cookies are not: another server of this computer never sees it.
localStorage.setItem("dtwin-key", document.currentScript.dataset.key);
location.replace(document.currentScript.dataset.to);
