// Read only by browsers that know no modules.
document.addEventListener("DOMContentLoaded", function () {
  var place = document.getElementById("old");
  place.removeAttribute("hidden");
  place.textContent = "This browser is too old for this page: use one of 2020 or later, or the terminal (the same command without --page).";
});
