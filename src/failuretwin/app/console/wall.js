// The wall of robots: tiles are text, never markup; search and filters work without the server.
export default {
  template: `
    <section>
      <form class="wall-filters" role="search" @submit.prevent>
        <label>{{ words.search }} <input type="search" v-model="search" name="search"></label>
        <label v-for="key in ['kind', 'site', 'mode', 'states']" :key="key">{{ words.filters[key] }}
          <select v-model="chosen[key]" :name="key">
            <option value="">{{ words.all }}</option>
            <option v-for="value in values(key)" :key="value" :value="value">
              {{ key === 'states' ? words.states[value] : value }}</option>
          </select></label>
        <output v-if="loaded">{{ visible.length }} {{ words.shown }} {{ tiles.size }} {{ words.robots }}</output>
      </form>
      <p v-if="!visible.length" role="status">{{ loaded ? words.none : words.loading }}</p>
      <ul class="wall">
        <li v-for="tile in visible" :key="tile.name">
          <a :href="'/robot?name=' + encodeURIComponent(tile.name)" :class="'edge-' + tile.states[0]">
            <strong>{{ tile.name }}</strong>
            <span class="badges"><span v-for="state in tile.states" :key="state" :class="'state state-' + state">
              {{ words.signs[state] }} {{ words.states[state] }}</span></span>
            <span class="said">{{ tile.said }}</span>
            <small>{{ [tile.kind, tile.site].filter(Boolean).join(', ') }}
              <template v-if="tile.heard">{{ words.heard }} {{ time(tile.heard) }}</template></small>
          </a>
        </li>
      </ul>
    </section>`,
  props: { words: Object },
  data() {
    return {
      tiles: new Map(),
      loaded: false,
      search: "",
      chosen: { kind: "", site: "", mode: "", states: "" },
      format: new Intl.DateTimeFormat("sv-SE", { dateStyle: "short", timeStyle: "medium" }),
    };
  },
  computed: {
    visible() {
      const search = this.search.toLowerCase();
      const fits = (tile) =>
        (!search || (tile.name + " " + tile.said).toLowerCase().includes(search)) &&
        Object.entries(this.chosen).every(([key, value]) => !value || this.parts(tile, key).includes(value));
      return [...this.tiles.values()]
        .filter(fits)
        .sort((a, b) => a.rank - b.rank || (a.name < b.name ? -1 : 1));
    },
  },
  mounted() {
    this.$emit("ready");
  },
  methods: {
    parts(tile, key) {
      return key === "mode" ? tile.mode.split(", ") : [tile[key]].flat();
    },
    values(key) {
      const found = new Set([...this.tiles.values()].flatMap((tile) => this.parts(tile, key)));
      found.delete("");
      return [...found].sort();
    },
    time(heard) {
      return this.format.format(new Date(heard));
    },
    update(changed, gone) {
      this.loaded = true;
      for (const tile of changed) this.tiles.set(tile.name, Object.freeze(tile));
      for (const name of gone) this.tiles.delete(name);
    },
  },
};
