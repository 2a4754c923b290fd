// Day and night: as the system says, or as chosen.
import { forgetColours } from "./text.js";

const ORDER = ["auto", "day", "night"];
const KEY = "fusiond-theme";
const dark = matchMedia("(prefers-color-scheme: dark)");

export class Theme {
  constructor(button, onChange) {
    Object.assign(this, { button, onChange });
    this.chosen = ORDER.includes(localStorage.getItem(KEY)) ? localStorage.getItem(KEY) : "auto";
    button.onclick = () => this.next();
    dark.addEventListener("change", () => this.apply());
    this.apply(false);
  }

  next() {
    this.chosen = ORDER[(ORDER.indexOf(this.chosen) + 1) % ORDER.length];
    localStorage.setItem(KEY, this.chosen);
    this.apply();
  }

  apply(tell = true) {
    const night = this.chosen === "night" || (this.chosen === "auto" && dark.matches);
    document.documentElement.dataset.theme = night ? "night" : "day";
    forgetColours();
    this.button.textContent = this.chosen;
    if (tell) this.onChange();
  }
}
