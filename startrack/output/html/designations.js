// Designations of stars in one form: "alpha Cen", "alf Cen", "α Cen" and "Alpha Centauri" are the same.
const GREEK = "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi omicron pi rho sigma tau upsilon phi chi psi omega".split(" ");
const GREEK_SIGNS = "αβγδεζηθικλμνξοπρστυφχψω";
const OTHER_LETTERS = { alf: "alpha", tet: "theta", ksi: "xi" }; // abbreviations of SIMBAD that do not begin the letter's name
const SUPERSCRIPTS = "⁰¹²³⁴⁵⁶⁷⁸⁹";
const CONSTELLATIONS = new Map(`And Andromedae|Ant Antliae|Aps Apodis|Aqr Aquarii|Aql Aquilae|Ara Arae|Ari Arietis|Aur Aurigae|Boo Bootis|Cae Caeli|Cam Camelopardalis|Cnc Cancri
CVn Canum Venaticorum|CMa Canis Majoris|CMi Canis Minoris|Cap Capricorni|Car Carinae|Cas Cassiopeiae|Cen Centauri|Cep Cephei|Cet Ceti|Cha Chamaeleontis|Cir Circini|Col Columbae
Com Comae Berenices|CrA Coronae Australis|CrB Coronae Borealis|Crv Corvi|Crt Crateris|Cru Crucis|Cyg Cygni|Del Delphini|Dor Doradus|Dra Draconis|Equ Equulei|Eri Eridani|For Fornacis
Gem Geminorum|Gru Gruis|Her Herculis|Hor Horologii|Hya Hydrae|Hyi Hydri|Ind Indi|Lac Lacertae|Leo Leonis|LMi Leonis Minoris|Lep Leporis|Lib Librae|Lup Lupi|Lyn Lyncis|Lyr Lyrae
Men Mensae|Mic Microscopii|Mon Monocerotis|Mus Muscae|Nor Normae|Oct Octantis|Oph Ophiuchi|Ori Orionis|Pav Pavonis|Peg Pegasi|Per Persei|Phe Phoenicis|Pic Pictoris|Psc Piscium
PsA Piscis Austrini|Pup Puppis|Pyx Pyxidis|Ret Reticuli|Sge Sagittae|Sgr Sagittarii|Sco Scorpii|Scl Sculptoris|Sct Scuti|Ser Serpentis|Sex Sextantis|Tau Tauri|Tel Telescopii
Tri Trianguli|TrA Trianguli Australis|Tuc Tucanae|UMa Ursae Majoris|UMi Ursae Minoris|Vel Velorum|Vir Virginis|Vol Volantis|Vul Vulpeculae`.split(/[|\n]/).flatMap((entry) => {
  const [short, genitive] = [entry.slice(0, 3).toLowerCase(), entry.slice(4).toLowerCase()];
  return [[short, short], [genitive, short]];
}));

const plain = (text) => text.toLowerCase().replace(/\s+/g, " ").trim();

const letterOf = (word) => OTHER_LETTERS[word] || GREEK.find((letter) => letter === word)
  || (word.length === 3 ? GREEK.find((letter) => letter.startsWith(word)) : null) || word;

// Letter or number, index and constellation of a designation; null of other texts.
function designationOf(text) {
  const spelled = plain(text.normalize("NFD").replace(/\p{M}/gu, "")).replace(/ς/g, "σ").replace(/[α-ω]/g, (sign) => `${GREEK[GREEK_SIGNS.indexOf(sign)]} `)
    .replace(/[⁰¹²³⁴⁵⁶⁷⁸⁹]/g, (digit) => SUPERSCRIPTS.indexOf(digit));
  const found = /^([a-z]+?|\d+|[a-z]+\d{3,}) ?\.? ?0*(\d?) ([a-z]+(?: [a-z]+)?)$/.exec(plain(spelled));
  const constellation = found && CONSTELLATIONS.get(found[3]);
  return constellation ? { letter: letterOf(found[1]), index: found[2], constellation } : null;
}

// Whether a star with the designation `of` is meant by `words`: all components where these have no index.
function isDesignation(of, words) {
  return Boolean(of && words) && of.letter === words.letter && of.constellation === words.constellation && (!words.index || of.index === words.index);
}
